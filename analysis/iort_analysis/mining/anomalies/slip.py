"""Slip: the motor's speed beside that of the car's pose, with torque and without."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.readings import MOVING_KRPM, Array, Readings
from iort_analysis.results import Mined
from iort_analysis.statistics.intervals import mean_of, sides
from iort_contract.messages.analysis import Estimate

SLIP = "slip_under_torque"
# Distances over this time are compared: long enough for a pose with a centimetre's noise.
_OVER_S = 0.25
# Nearly no torque is below this share of the high currents, and much torque is above that one.
_HIGH, _IDLE, _TORQUE = 0.95, 0.25, 0.6
# The drive in so many parts gives the gain's interval.
_PARTS, _LEAST, _LEAST_PULLS = 20, 200, 20


class _Ways(NamedTuple):
    """The motor's turns in thousands, the car's way in metres, and the mean current, over some time."""

    turns: Array
    moved_m: Array
    amps: Array


def mine_slip(drive: Drive, samples: Readings) -> Mined:
    """How much further the wheels turn with much torque than without."""
    pose = None if drive.pose in {None, drive.vesc} else drive.streams[drive.pose or ""]
    if pose is None or len(pose.times_us) < _LEAST:
        return _missing("the drive has no second source of speed, such as a pose")
    ways = _ways(
        (pose.times_us - drive.samples.times_us[0]) / 1e6, pose.columns["x"], pose.columns["y"], samples
    )
    if len(ways.turns) < _LEAST:
        return _missing("the car hardly moves")
    high = float(np.quantile(ways.amps, _HIGH))
    idle, pulls = np.abs(ways.amps) < _IDLE * high, ways.amps > _TORQUE * high
    if idle.sum() < _LEAST / 2 or pulls.sum() < _LEAST_PULLS:
        return _missing("the car hardly drives with and without torque")
    parts = np.array_split(np.flatnonzero(idle), _PARTS)
    gains = np.array([float(ways.turns[part].sum() / ways.moved_m[part].sum()) for part in parts])
    gain, low, high = mean_of(gains)
    # What the wheels turned further in this drive; the pose's noise is the error, as it is without torque.
    noise_m = float(np.std(ways.moved_m[idle] - ways.turns[idle] / gain))
    turned_m = float(ways.turns[pulls].sum()) / gain
    slip = 1 - float(ways.moved_m[pulls].sum()) / turned_m
    half = math.hypot(sides() * noise_m * math.sqrt(float(pulls.sum())) / turned_m, (high - low) / 2 / gain)
    return Mined(estimates={SLIP: Estimate(slip, slip - half, slip + half, "1")})


def _ways(seconds: Array, x_m: Array, y_m: Array, samples: Readings) -> _Ways:
    """Forward ways over `_OVER_S`, where motor and pose are known all the time."""
    step = max(1, round(_OVER_S / float(np.median(np.diff(seconds)))))

    def over(values: Array) -> Array:
        return np.asarray(np.diff(values[::step]))

    def summed(values: Array) -> Array:
        return over(np.interp(seconds, samples.seconds, samples.summed(values)))

    turns, took = summed(samples.krpm), over(seconds)
    gaps = summed(np.isnan(samples.krpm * samples.motor_a).astype(np.float64))
    moved_m = np.hypot(over(x_m), over(y_m))
    known = np.isfinite(moved_m) & (took < 2 * _OVER_S) & (gaps == 0) & (turns > MOVING_KRPM * took)
    return _Ways(turns[known], moved_m[known], (summed(samples.motor_a) / took)[known])


def _missing(reason: str) -> Mined:
    return Mined(missing={SLIP: reason})
