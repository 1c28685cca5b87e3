"""Every parameter that an analysis of drives can estimate: a miner's estimate is an entry of `PARAMETERS`,
and every kind of finding is one of `KINDS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

from iort_contract.catalog.car import BATTERY, FORCES, HEAT, MOTOR
from iort_contract.catalog.entries import Parameter

_LAPS = (
    Parameter("lap_best_s", "s", "time of the best lap", worse="up"),
    Parameter("lap_mean_s", "s", "mean time of the complete laps", worse="up"),
    Parameter("lap_distance_m", "m", "mean length of the complete laps"),
    Parameter("lap_energy_wh", "Wh", "mean energy of a lap, out of the battery", worse="up"),
    Parameter("lap_energy_wh_per_km", "Wh/km", "mean energy of a lap for its length", worse="up"),
)
# The tables of laps: what each took, and when it passed each place.
LAPS_TABLE, PLACES_TABLE = "laps", "lap_places"

# What the motor needs and what its sensors say; currents and speeds as the VESC has them, so that no number
# of the car need be known.
_DRIVETRAIN = (
    Parameter(
        "inertia_a_per_krpm_s",
        "A s/krpm",
        "motor current for an acceleration of 1000 erpm in a second: mass and gears",
        worse="up",
        kind="payload_added",
        fields=("current_motor", "speed"),
        least_share=0.08,
    ),
    Parameter(
        "rolling_current_a",
        "A",
        "motor current that rolling takes, without air drag",
        worse="up",
        kind="friction_added",
        fields=("current_motor", "speed"),
        least=0.8,
    ),
    Parameter(
        "brake_drag_a",
        "A",
        "motor current against a brake that still holds, just after braking",
        worse="up",
        kind="brake_dragging",
        fields=("current_motor", "speed"),
        least=2.0,
        least_share=0.0,
    ),
    Parameter(
        "slip_under_torque",
        "1",
        "share that the motor turns further under much torque than without",
        worse="up",
        kind="pinion_loose",
        fields=("speed", "current_motor"),
        least=0.015,
        least_share=0.0,
    ),
)
_drift = partial(Parameter, kind="sensor_drift", least_share=0.0)
_SENSORS = (
    _drift(
        "voltage_drift_v",
        "V",
        "error of the battery's voltage that grew in the drive, against duty cycle, speed and current",
        fields=("voltage_input", "duty_cycle", "speed"),
        least=0.15,
    ),
    _drift(
        "motor_current_drift_a",
        "A",
        "error of the motor's current that grew in the drive, against duty cycle and battery current",
        fields=("current_motor", "current_input", "duty_cycle"),
        least=0.6,
    ),
    _drift(
        "temperature_drift_k",
        "K",
        "error of the controller's temperature that grew in the drive, against how a board warms up",
        fields=("temperature_pcb", "temp_fet", "current_motor"),
        least=3.5,
    ),
    Parameter(
        "controller_lag_s",
        "s",
        "time in which the controller's temperature follows its load: longer with less cooling",
        worse="up",
        kind="cooling_lost",
        fields=("temperature_pcb", "temp_fet", "current_motor"),
        least_share=0.5,
    ),
)

# The groups in the order in which a person reads them.
GROUPS = {
    "Battery": BATTERY,
    "Motor": MOTOR,
    "Drivetrain": _DRIVETRAIN + FORCES,
    "Heat": HEAT,
    "Sensors": _SENSORS,
    "Laps": _LAPS,
}
PARAMETERS = {parameter.name: parameter for group in GROUPS.values() for parameter in group}


# The severity that a person gets a mail for, and the kind of a drive that has no result.
SERIOUS, ANALYSIS_FAILED = "serious", "analysis_failed"
# The kind of a robot's drives beyond those that a night takes of it.
DRIVES_WAIT = "drives_wait"


@dataclass(frozen=True)
class Kind:
    """A kind of finding. ``meaning`` says what happened, ``action`` what a person does, in Markdown.

    The operator gets a mail for a ``serious`` one. ``explains`` are the kinds that the same cause raises:
    beside this one they are no findings of their own. ``alternatives`` are other causes, in words, that the
    data cannot tell from this one.
    """

    name: str
    meaning: str
    action: str
    severity: Literal["info", "warning", "serious"] = "warning"
    explains: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()


KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            "battery_worn",
            "the battery's internal resistance has grown",
            "charge it fully and compare with another battery; look for a warm plug or a loose wire; replace "
            "the battery if the resistance stays",
            alternatives=("a bad contact between battery and controller", "a much colder battery"),
        ),
        Kind(
            "cell_dropout",
            "the battery's voltage drops for moments under load",
            "stop driving with this battery; measure its cells at rest and under load; check the plug",
            severity="serious",
            explains=("battery_worn",),
            alternatives=("a loose battery plug",),
        ),
        Kind(
            "friction_added",
            "the car needs more current to roll",
            "lift the car and turn the wheels by hand; oil bearings and gears; check the pinion's mesh",
            alternatives=("a softer ground", "wheels out of line"),
        ),
        Kind(
            "tyre_flat",
            "the wheels turn more often for the same way",
            "look for a flat or worn tyre, and a wheel that turns on its rim; after new tyres or gears"
            " run `iort calibrate`",
            explains=("friction_added", "payload_added", "brake_dragging"),
            alternatives=("smaller wheels or another gear than before",),
        ),
        Kind(
            "brake_dragging",
            "the car is held for seconds after it braked",
            "lift the car, brake, and turn the wheels by hand; free the brake, and check its cable or servo",
            explains=("friction_added", "payload_added"),
        ),
        Kind(
            "pinion_loose",
            "the motor turns faster than the car moves, under torque",
            "tighten the pinion's screw, and look at the gears' teeth; look whether the tyres spin instead",
            severity="serious",
            explains=("payload_added", "tyre_flat", "friction_added", "brake_dragging"),
            alternatives=("tyres that spin",),
        ),
        Kind(
            "payload_added",
            "the car accelerates less for the same current",
            "weigh the car; after a change on purpose nothing is to be done",
            severity="info",
            explains=("friction_added",),
            alternatives=("a weaker motor",),
        ),
        Kind(
            "motor_resistance_grown",
            "the motor's phases have more resistance",
            "check the three phase wires and their plugs for a bad joint; compare again with a cold motor",
            # More resistance is more heat.
            explains=("cooling_lost",),
            alternatives=("a hotter motor than usual",),
        ),
        Kind(
            "cooling_lost",
            "the controller or the motor cools less than before",
            "check the fan, the air's way and the heat sink's screws; watch the temperature",
        ),
        Kind(
            "sensor_stuck",
            "a field kept exactly the same value while the car moved",
            "check the sensor and its wires; the analysis leaves out the samples in between",
        ),
        Kind(
            "sensor_drift",
            "a field went away from what the other fields say",
            "compare the field with a meter; calibrate or replace the sensor",
            explains=(
                "friction_added",
                "payload_added",
                "brake_dragging",
                "motor_resistance_grown",
                "battery_worn",
                "cooling_lost",
            ),
        ),
        Kind(
            "can_intermittent",
            "samples of the motor controller are missing again and again",
            "check the cable and plugs between computer and controller, and the CAN bus' terminators",
            alternatives=("batches that were lost on their way to the cloud, which `iort audit` lists",),
        ),
        Kind(
            "fault_reported",
            "the motor controller reported a fault",
            "read what the fault's name means in VESC Tool's manual; look at the evidence in the history",
            severity="serious",
        ),
        Kind(
            "never_moved",
            "a robot recorded and never moved",
            "nothing, if it stood; if it drove, look at the field of its speed in the history: whether it is "
            "the car's, and in the unit that the text names",
            severity="info",
        ),
        Kind(
            ANALYSIS_FAILED,
            "a drive could not be analysed",
            "the text has the reason; the samples are kept, so `iort analyse` can try it again",
        ),
        Kind(
            DRIVES_WAIT,
            "a robot has more drives than a night takes of it",
            "the next nights take the rest, for a week; `iort analyse` takes all at once. A robot that "
            "begins so many runs restarts all the time, or is not what it says",
            severity="info",
        ),
    )
}
