"""The parameters of a car's parts: battery, motor, what the motor moves, and heat; and what the operator may
tell of a car."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from iort_contract.catalog.entries import Parameter


class Known(NamedTuple):
    """A number of a car that no sensor tells, and its limits."""

    unit: str
    meaning: str
    least: float
    most: float
    whole: bool = False


# By `iort robots set`, into the robot's row; the analysis has them as the drive's ``known``.
KNOWN = {
    "mass_kg": Known("kg", "mass of the car", 0.1, 10_000),
    "pole_pairs": Known("1", "pole pairs of the motor", 1, 50, whole=True),
    "cells": Known("1", "cells of the battery in series", 1, 100, whole=True),
    "capacity_ah": Known("Ah", "rated capacity of the battery", 0.01, 1000),
}

_BATTERY = ("voltage_input", "current_input")
# What the battery has after the drive.
_left = partial(Parameter, fields=_BATTERY, state=True)
BATTERY = (
    Parameter(
        "battery_resistance_ohm",
        "ohm",
        "resistance of the battery and its wires at once",
        worse="up",
        kind="battery_worn",
        fields=_BATTERY,
    ),
    Parameter(
        "battery_slow_resistance_ohm",
        "ohm",
        "what the battery's resistance grows by within minutes of load",
        worse="up",
        fields=_BATTERY,
    ),
    _left("battery_open_voltage_v", "V", "open-circuit voltage at the drive's end, as after a long rest"),
    _left(
        "battery_voltage_per_ah",
        "V/Ah",
        "fall of the open-circuit voltage with the charge drawn; more in a smaller or emptier battery",
    ),
    _left(
        "battery_drawn_share", "1", "charge that the drive drew, as a share of the battery's rated capacity"
    ),
    _left(
        "battery_charge_left",
        "1",
        "charge in the battery at the drive's end, as a share; by the voltage of its cells at rest",
    ),
    Parameter(
        "battery_range_left_km",
        "km",
        "how far that charge takes the car, driven as in this drive",
        fields=(*_BATTERY, "speed"),
        state=True,
    ),
)

_MOTOR = ("duty_cycle", "voltage_input", "current_motor", "avg_vq", "avg_iq", "speed")
MOTOR = (
    Parameter(
        "motor_resistance_25_ohm",
        "ohm",
        "resistance of a motor's phase with MOSFETs and wires, at 25 degC",
        worse="up",
        kind="motor_resistance_grown",
        fields=_MOTOR,
        least_share=0.1,
    ),
    Parameter(
        "motor_resistance_ohm",
        "ohm",
        "resistance of a motor's phase with MOSFETs and wires, as warm as it was in the drive",
        worse="up",
        kind="motor_resistance_grown",
        fields=_MOTOR,
        least_share=0.15,
    ),
    Parameter(
        "motor_flux_linkage_wb",
        "Wb",
        "flux linkage of the motor's magnets: voltage of a phase for an electrical rad/s",
        fields=_MOTOR,
    ),
    Parameter(
        "motor_volts_per_krpm",
        "V/krpm",
        "voltage across two phases (duty cycle times battery voltage) for 1000 erpm, where the control is not"
        " field-oriented",
        fields=("duty_cycle", "voltage_input", "speed"),
    ),
    Parameter(
        "motor_volts_per_a",
        "V/A",
        "the same voltage for an ampere of the motor",
        worse="up",
        fields=("duty_cycle", "voltage_input", "current_motor"),
    ),
    Parameter(
        "motor_inductance_h", "H", "inductance of a motor's phase", fields=("avg_vd", "avg_iq", "speed")
    ),
    Parameter(
        "motor_torque_nm_per_a", "Nm/A", "torque of the motor for an ampere, with its number of pole pairs"
    ),
)

_moved = partial(Parameter, fields=("current_motor", "speed"))
FORCES = (
    Parameter(
        "speed_to_erpm_gain",
        "erpm per m/s",
        "motor speed for a speed of the car, over the drive; as in vesc.yaml",
        worse="up",
        kind="tyre_flat",
        fields=("speed",),
        least_share=0.03,
    ),
    Parameter("motor_force_n_per_a", "N/A", "force at the tyres for an ampere of the motor, without losses"),
    _moved("effective_mass_kg", "kg", "mass that the motor moves, with that of what turns"),
    _moved(
        "rotating_mass_kg",
        "kg",
        "inertia of motor, gears and wheels, as a mass at the tyres; with the car's known mass",
    ),
    _moved("friction_n", "N", "force that rolling takes at any speed", worse="up"),
    _moved("drag_n_s2_per_m2", "N s2/m2", "force of the air, by the square of the speed"),
    _moved("drivetrain_efficiency", "1", "share of the motor's force that the gears pass on", worse="down"),
    _moved("brake_drag_n", "N", "force of a brake that still holds, just after braking", worse="up"),
    _moved(
        "acceleration_per_a_mps2",
        "m/s2/A",
        "acceleration for an ampere of the motor, without friction",
        worse="down",
    ),
    _moved("friction_per_mass_mps2", "m/s2", "how fast the car slows down as it rolls", worse="up"),
)

_BODIES = {"motor": ("temp_motor",), "controller": ("temp_fet", "temperature_pcb")}
HEAT = tuple(
    parameter
    for name, fields in _BODIES.items()
    for heated in (partial(Parameter, fields=("current_motor", *fields)),)
    for parameter in (
        heated(
            f"{name}_rise_k_per_a2",
            "K/A2",
            f"warming of the {name} for each A2 of the motor current's mean square, with the drive's wind",
            worse="up",
            kind="cooling_lost",
            least_share=0.4,
        ),
        heated(
            f"{name}_thermal_resistance_k_per_w",
            "K/W",
            f"warming of the {name} for each watt lost in motor and controller together",
            worse="up",
        ),
        heated(
            f"{name}_final_degc",
            "degC",
            f"temperature at which the {name} settles, if the load of the drive's last minutes goes on",
            worse="up",
            state=True,
        ),
        heated(
            f"{name}_time_to_limit_s",
            "s",
            f"time until the {name} reaches 85 degC, if the load of the drive's last minutes goes on",
            worse="down",
            state=True,
        ),
    )
)

# The groups in the order in which a person reads them.
GROUPS = {"Battery": BATTERY, "Motor": MOTOR, "Forces": FORCES, "Heat": HEAT}
