"""The VESC's fields that the tests for anomalies compare."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SPEED, MOTOR, BATTERY, DUTY, VOLTAGE = (
    "speed",
    "current_motor",
    "current_input",
    "duty_cycle",
    "voltage_input",
)
# Beyond it the controller cannot turn the duty cycle up, and regulates otherwise.
FULL_DUTY = 0.93
# Electrical revolutions a minute: what moves, and what moves fast.
KRPM = 1000.0
MOVING_KRPM = 2.0
# Shorter drives say nothing of a drift, and too little of anything else.
LEAST_S = 60.0


class Readings(NamedTuple):
    """Samples of a drive: seconds since its first one, thousands of erpm, amperes, share, volts."""

    seconds: Array
    krpm: Array
    motor_a: Array
    duty: Array
    voltage_v: Array
    battery_a: Array

    def summed(self, values: Array) -> Array:
        """The integral over time up to each sample."""
        steps = np.diff(self.seconds)
        known = np.nan_to_num(values)
        return np.append(0.0, np.cumsum((known[1:] + known[:-1]) / 2 * steps))


def readings(drive: Drive) -> Readings | str:
    """The readings, or the reason why a drive has none."""
    seconds = drive.seconds
    if not len(seconds) or seconds[-1] < LEAST_S:
        return f"the drive must last {LEAST_S:g} s, got {seconds[-1] if len(seconds) else 0:.0f} s"
    found = {name: drive.of(drive.vesc, name) for name in (SPEED, MOTOR, DUTY, VOLTAGE, BATTERY)}
    if absent := [name for name, column in found.items() if column is None]:
        return f"the drive has no {' and no '.join(absent)}"
    speed, motor_a, duty, voltage_v, battery_a = (
        np.asarray(column, dtype=np.float64) for column in found.values()
    )
    return Readings(seconds, speed / KRPM, motor_a, duty, voltage_v, battery_a)
