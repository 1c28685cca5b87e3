"""Every parameter that an analysis of drives can estimate: a miner's estimate is an entry of `PARAMETERS`."""

from __future__ import annotations

from iort_contract.catalog.analysis.car import BATTERY, FORCES, HEAT, MOTOR
from iort_contract.catalog.analysis.parameter import Parameter

_LAPS = (
    Parameter("lap_best_s", "s", "time of the best lap", worse="up"),
    Parameter("lap_mean_s", "s", "mean time of the complete laps", worse="up"),
    Parameter("lap_distance_m", "m", "mean length of the complete laps"),
    Parameter("lap_energy_wh", "Wh", "mean energy of a lap, out of the battery", worse="up"),
    Parameter("lap_energy_wh_per_km", "Wh/km", "mean energy of a lap for its length", worse="up"),
)
# The tables of laps: what each took, and when it passed each place.
LAPS_TABLE, PLACES_TABLE = "laps", "lap_places"
# How a car is driven, over half a second; `mining.style` says when each is.
STYLES = {
    "standing": "the car stands",
    "hard braking": "the speed falls fast",
    "hard accelerating": "the speed rises fast",
    "corner at the limit": "a corner with nearly all the grip that the drive used",
    "cornering": "a corner below that",
    "steady fast": "a speed near the drive's highest, held",
    "steady slow": "a lower speed, held",
}
STYLE_TABLE = "style"
STYLE_GROUP = "Driving style"
_STYLES = tuple(
    Parameter(f"style_{style.replace(' ', '_')}_share", "1", f"share of time: {meaning}")
    for style, meaning in STYLES.items()
)

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
_SENSORS = (
    Parameter(
        "voltage_drift_v",
        "V",
        "error of the battery's voltage that grew in the drive, against duty cycle, speed and current",
        kind="sensor_drift",
        fields=("voltage_input", "duty_cycle", "speed"),
        least=0.15,
        least_share=0.0,
    ),
    Parameter(
        "motor_current_drift_a",
        "A",
        "error of the motor's current that grew in the drive, against duty cycle and battery current",
        kind="sensor_drift",
        fields=("current_motor", "current_input", "duty_cycle"),
        least=0.6,
        least_share=0.0,
    ),
    Parameter(
        "temperature_drift_k",
        "K",
        "error of the controller's temperature that grew in the drive, against how a board warms up",
        kind="sensor_drift",
        fields=("temperature_pcb", "temp_fet", "current_motor"),
        least=3.5,
        least_share=0.0,
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
    STYLE_GROUP: _STYLES,
}
PARAMETERS = {parameter.name: parameter for group in GROUPS.values() for parameter in group}
