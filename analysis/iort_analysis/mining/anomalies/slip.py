"""Two speeds: the motor's beside that of the car's pose. Their ratio tells the wheels' size, and slip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.readings import KRPM, MOVING_KRPM, Array, Readings
from iort_analysis.mining.intervals import mean_of
from iort_analysis.results import Mined
from iort_contract.messages.findings import Estimate

GAIN, SLIP = "erpm_per_mps", "slip_under_torque"
# Distances over this time are compared: long enough for a pose with a centimetre's noise.
_OVER_S = 0.25
# Nearly no torque is below this share of the high currents, and much torque is above that one.
_HIGH, _IDLE, _TORQUE = 0.95, 0.25, 0.6
# The drive in so many parts gives the interval.
_PARTS, _LEAST = 20, 200


class _Ways(NamedTuple):
    """The motor's turns in thousands, the car's way in metres, and the mean current, over some time."""

    turns: Array
    moved_m: Array
    amps: Array


def mine_slip(drive: Drive, samples: Readings) -> Mined:
    """The wheels' turns for a metre without torque, and how many more with much torque."""
    pose = None if drive.pose in {None, drive.vesc} else drive.streams[drive.pose or ""]
    if pose is None or len(pose.times_us) < _LEAST:
        return _missing("the drive has no second source of speed, such as a pose")
    ways = _ways(
        (pose.times_us - drive.samples.times_us[0]) / 1e6, pose.columns["x"], pose.columns["y"], samples
    )
    if len(ways.turns) < _LEAST:
        return _missing("the car hardly moves")
    high = float(np.quantile(ways.amps, _HIGH))
    parts = np.array_split(np.arange(len(ways.turns)), _PARTS)
    gains, slips = [], []
    for part in parts:
        turns, moved_m, amps = (values[part] for values in ways)
        idle, pulls = np.abs(amps) < _IDLE * high, amps > _TORQUE * high
        if not moved_m[idle].sum() > 0:
            continue
        gains.append(float(turns[idle].sum() / moved_m[idle].sum()))
        if moved_m[pulls].sum() > 0:
            slips.append(1 - float(moved_m[pulls].sum() / turns[pulls].sum()) * gains[-1])
    found = {GAIN: (KRPM * np.array(gains), "erpm per m/s"), SLIP: (np.array(slips), "1")}
    known = {name: one for name, one in found.items() if len(one[0]) >= _PARTS / 2}
    return Mined(
        estimates={name: Estimate(*mean_of(values), unit) for name, (values, unit) in known.items()},
        missing=dict.fromkeys(found.keys() - known.keys(), "the car hardly drives with and without torque"),
    )


def _ways(seconds: Array, x_m: Array, y_m: Array, samples: Readings) -> _Ways:
    """Forward ways over `_OVER_S`, where motor and pose are known all the time."""
    step = max(1, round(_OVER_S / float(np.median(np.diff(seconds)))))

    def over(values: Array) -> Array:
        return np.asarray(values[step:] - values[:-step])

    def summed(values: Array) -> Array:
        return over(np.interp(seconds, samples.seconds, samples.summed(values)))

    turns, took = summed(samples.krpm), over(seconds)
    gaps = summed(np.isnan(samples.krpm * samples.motor_a).astype(np.float64))
    moved_m = np.hypot(over(x_m), over(y_m))
    known = np.isfinite(moved_m) & (took < 2 * _OVER_S) & (gaps == 0) & (turns > MOVING_KRPM * took)
    return _Ways(turns[known], moved_m[known], (summed(samples.motor_a) / took)[known])


def _missing(reason: str) -> Mined:
    return Mined(missing={GAIN: reason, SLIP: reason})
