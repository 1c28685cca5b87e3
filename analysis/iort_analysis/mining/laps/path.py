"""The way of a car over the ground: its positions in metres, and the distance along them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.samples.positions import fixes, local_metres, position_fields

Floats = NDArray[np.float64]
_LEAST_POSITIONS = 30
# Positions closer together than this many times their noise would add the noise to the distance.
_APART_NOISES = 20
# The differences of four positions in a row, whose variance is 20 times a position's.
_THIRD_DIFFERENCE = math.sqrt(20)
# A median of absolute values, as a standard deviation.
_MAD = 1.4826


@dataclass(frozen=True)
class Path:
    """Positions some distance apart, so that neither noise nor a stand adds to the way.

    ``seconds`` counts from the drive's first position; ``passed_m`` is the distance along the way.
    ``noise_m`` is the standard deviation of a measured position, and ``extent_m`` the diagonal of the area.
    """

    start_us: int
    seconds: Floats
    x_m: Floats
    y_m: Floats
    noise_m: float
    extent_m: float

    @cached_property
    def passed_m(self) -> Floats:
        """The distance from the first position."""
        steps = np.hypot(np.diff(self.x_m), np.diff(self.y_m))
        return np.concatenate([[0.0], np.cumsum(steps)])

    def seconds_at(self, passed_m: Floats) -> Floats:
        """The times at distances along the way."""
        return np.interp(passed_m, self.passed_m, self.seconds)

    def position_at(self, passed_m: Floats) -> tuple[Floats, Floats]:
        """The positions at distances along the way."""
        return np.interp(passed_m, self.passed_m, self.x_m), np.interp(passed_m, self.passed_m, self.y_m)


def path_of(drive: Drive) -> Path | str:
    """The way of a drive by its stream of positions; a text says why there is none."""
    placed = {name: fields for name, b in drive.streams.items() if (fields := position_fields(b.columns))}
    stream = drive.pose if drive.pose in placed else min(placed, default=None)
    if stream is None:
        return "no stream has a position"
    block, fields = drive.streams[stream], placed[stream]
    if fields.degrees:
        latitude, longitude = fixes(block.columns, fields)
        known = np.flatnonzero(~np.isnan(latitude))
        if not len(known):
            return f"no position in {stream} has a fix"
        x, y = local_metres(latitude, longitude, (float(latitude[known[0]]), float(longitude[known[0]])))
    else:
        x, y = (block.columns[name].astype(np.float64) for name in fields.names)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    times = block.times_us[known]
    later = np.append(True, times[1:] > times[:-1])[: len(known)]
    known, times = known[later], times[later]
    if len(known) < _LEAST_POSITIONS:
        return f"{stream} has {len(known)} positions, at least {_LEAST_POSITIONS} are needed"
    x, y = x[known], y[known]
    noise_m = float(np.hypot(_noise(x), _noise(y))) / math.sqrt(2)
    spans = [np.diff(np.percentile(each, [1, 99]))[0] for each in (x, y)]
    extent_m = float(np.hypot(*spans))
    kept = _apart(x, y, max(_APART_NOISES * noise_m, extent_m / 500))
    if len(kept) < _LEAST_POSITIONS:
        return "the car hardly moved"
    return Path(int(times[0]), (times[kept] - times[0]) / 1e6, x[kept], y[kept], noise_m, extent_m)


def _noise(values: Floats) -> float:
    """The noise of positions that are sampled faster than the car changes its acceleration."""
    return float(np.median(np.abs(np.diff(values, 3)))) * _MAD / _THIRD_DIFFERENCE


def _apart(x: Floats, y: Floats, least_m: float) -> NDArray[np.intp]:
    """The indexes of positions that are at least so far from the one kept before."""
    kept, least2 = [0], least_m**2
    at_x, at_y = x[0], y[0]
    for i, (here_x, here_y) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        if (here_x - at_x) ** 2 + (here_y - at_y) ** 2 >= least2:
            kept.append(i)
            at_x, at_y = here_x, here_y
    return np.array(kept, dtype=np.intp)
