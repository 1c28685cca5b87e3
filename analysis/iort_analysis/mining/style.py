"""The driving style: clusters of half seconds, named by what distinguishes them, and their shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.results import Mined, Table
from iort_analysis.samples.blocks import Column
from iort_analysis.statistics.clusters import cluster, scaled
from iort_analysis.statistics.distributions import share_of
from iort_contract.catalog.analysis import STYLE_TABLE, STYLES
from iort_contract.messages.analysis import Estimate

Floats = NDArray[np.float64]
_WINDOW_S = 0.5
_LEAST_WINDOWS = 60
_MOST_CLUSTERS = 8
# Windows in a row are alike: so many are one independent one.
_WINDOWS_EACH = 4
# Slower than this share of the drive's highest speed, a car stands.
_STANDS = 0.03
# Shares of what the drive used at most (its 98th percentile).
_HARD, _AT_THE_LIMIT, _CORNER, _FAST = 0.4, 0.75, 0.35, 0.6
_LEAST_SHARE_MOVING = 0.02


def _name(style: str) -> str:
    return f"style_{style.replace(' ', '_')}_share"


def mine(drive: Drive) -> Mined:
    """The styles of a drive and their shares of its time."""
    erpm = drive.of(drive.vesc, "speed")
    if erpm is None:
        return Mined(missing={_name(style): "needs the motor's speed" for style in STYLES})
    vehicle = drive.vehicle
    speed = np.abs(
        erpm if vehicle is None else (erpm - vehicle.speed_to_erpm_offset) / vehicle.speed_to_erpm_gain
    )
    windows = _Windows(drive.seconds, speed.astype(np.float64), _turn_rate(drive))
    n = len(windows.features)
    if n < _LEAST_WINDOWS:
        reason = f"the drive has {n} half seconds, at least {_LEAST_WINDOWS} are needed"
        return Mined(missing={_name(style): reason for style in STYLES})
    names = windows.names()
    estimates = {
        _name(style): Estimate(*share_of((names == style).sum() / _WINDOWS_EACH, n / _WINDOWS_EACH), "1")
        for style in STYLES
        if windows.turns or "corner" not in style
    }
    missing = {
        _name(style): "needs a heading or a steering angle"
        for style in STYLES
        if _name(style) not in estimates
    }
    return Mined(
        estimates, missing, tables={STYLE_TABLE: windows.table(names, in_metres=vehicle is not None)}
    )


class _Windows:
    """Half seconds: mean speed, acceleration, and acceleration to the side."""

    def __init__(self, seconds: Floats, speed: Floats, turn_rate: Floats | None) -> None:
        window = np.floor(seconds / _WINDOW_S).astype(np.int64)
        starts = np.flatnonzero(np.append(True, np.diff(window) > 0))
        known = np.flatnonzero(np.isfinite(speed))
        speed = np.interp(np.arange(len(speed)), known, speed[known])
        ends = np.append(starts[1:], len(speed)) - 1
        counts = ends - starts + 1
        self.turns = turn_rate is not None
        self.speed = np.add.reduceat(speed, starts) / counts
        elapsed = np.maximum(seconds[ends] - seconds[starts], 1e-3)
        self.gain = np.where(counts > 1, (speed[ends] - speed[starts]) / elapsed, 0.0)
        aside = np.zeros(len(speed)) if turn_rate is None else np.abs(turn_rate * speed)
        self.aside = np.add.reduceat(aside, starts) / counts
        self.features = np.stack([self.speed, self.gain, self.aside], axis=1)

    def names(self) -> NDArray[np.object_]:
        """The style of every window: its cluster's, by the cluster's middle."""
        top = np.percentile(self.speed, 98)
        standing = self.speed <= _STANDS * top
        names = np.full(len(self.speed), "standing", dtype=object)
        moving = np.flatnonzero(~standing)
        if len(moving) <= max(2 * _MOST_CLUSTERS, _LEAST_SHARE_MOVING * len(self.speed)):
            return names
        columns = slice(0, 3 if self.turns else 2)
        labels = cluster(scaled(self.features[moving, columns]), _MOST_CLUSTERS).labels
        most = [
            np.percentile(np.abs(each[moving]), 98) or 1.0 for each in (self.speed, self.gain, self.aside)
        ]
        for each in np.unique(labels):
            inside = moving[labels == each]
            middle = [
                float(np.median(v[inside])) / m
                for v, m in zip((self.speed, self.gain, self.aside), most, strict=True)
            ]
            names[inside] = _style(*middle)
        return names

    def table(self, names: NDArray[np.object_], *, in_metres: bool) -> Table:
        """A row for each style that occurs, the most frequent first."""
        found = sorted(set(names), key=lambda style: -int((names == style).sum()))
        inside = [names == style for style in found]

        def mean(values: Floats) -> Column:
            return np.array([float(values[rows].mean()) if in_metres else np.nan for rows in inside])

        return {
            "style": np.array(found, dtype=object),
            "share": np.array([float(rows.mean()) for rows in inside]),
            "mean_speed_mps": mean(self.speed),
            "mean_acceleration_mps2": mean(self.gain),
            "mean_lateral_mps2": mean(self.aside) if self.turns else np.full(len(found), np.nan),
        }


def _style(speed: float, gain: float, aside: float) -> str:
    """The style of a cluster, by its middle in shares of what the drive used at most."""
    if aside >= _AT_THE_LIMIT:
        return "corner at the limit"
    if gain <= -_HARD:
        return "hard braking"
    if gain >= _HARD:
        return "hard accelerating"
    if aside >= _CORNER:
        return "cornering"
    return "steady fast" if speed >= _FAST else "steady slow"


def _turn_rate(drive: Drive) -> Floats | None:
    """The rate of turning in rad/s, by a gyroscope, or by the heading of the position's stream."""
    for name, column in drive.samples.columns.items():
        if name.endswith(("angular_velocity.z", "angular.z")) and np.isfinite(column).any():
            return np.nan_to_num(column.astype(np.float64))
    block = drive.streams.get(drive.pose or "")
    if block is None or "heading" not in block.columns or len(block.times_us) < _LEAST_WINDOWS:
        return None
    seconds = (block.times_us - drive.samples.times_us[0]) / 1e6
    heading = block.columns["heading"].astype(np.float64)
    known = np.flatnonzero(np.isfinite(heading))
    if len(known) < _LEAST_WINDOWS:
        return None
    seconds, heading = seconds[known], np.unwrap(heading[known])
    # Over a window, so that the heading's noise does not count as turning.
    ahead, behind = (np.interp(drive.seconds + way * _WINDOW_S / 2, seconds, heading) for way in (1, -1))
    return (ahead - behind) / _WINDOW_S
