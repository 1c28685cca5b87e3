"""Laps aligned by their places: when each lap passed the same places of the track."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iort_analysis.mining.laps.path import Floats, Path

# The places of a lap: a quarter of a metre apart in a hall.
PLACES = 200
# Each step lands closer to the line across the place; the ways of two laps differ little.
_STEPS = 4
# A speed is that between the places so far before and after: of neighbours it would be noise.
_AROUND = 2


class Places(NamedTuple):
    """The same places in each lap: their distances in the reference lap, and for every lap (a row) the time
    since its start."""

    place_m: Floats
    since_s: Floats

    @property
    def speed_mps(self) -> Floats:
        """The speed around each place, along the reference lap's line."""
        places = np.arange(len(self.place_m))
        before, after = np.maximum(places - _AROUND, 0), np.minimum(places + _AROUND, places[-1])
        seconds = np.maximum(self.since_s[:, after] - self.since_s[:, before], 1e-6)
        speed: Floats = (self.place_m[after] - self.place_m[before]) / seconds
        return speed


def by_position(path: Path, starts_m: Floats, ends_m: Floats, reference: int) -> Places:
    """When each lap passed the lines across the reference lap's way."""
    shares = np.linspace(0, 1, PLACES + 1)
    begin, end = starts_m[reference], ends_m[reference]
    x, y = path.position_at(begin + (end - begin) * shares)
    dx, dy = _direction(x), _direction(y)
    length = np.hypot(dx, dy)
    dx, dy = dx / length, dy / length
    passed = starts_m[:, None] + (ends_m - starts_m)[:, None] * shares
    for _ in range(_STEPS):
        here_x, here_y = path.position_at(passed)
        passed = passed - (here_x - x) * dx - (here_y - y) * dy
    # A lap starts and ends at the gate, and never goes backwards.
    passed[:, 0], passed[:, -1] = starts_m, ends_m
    passed = np.maximum.accumulate(np.clip(passed, starts_m[:, None], ends_m[:, None]), axis=1)
    seconds = path.seconds_at(passed)
    return Places((end - begin) * shares, seconds - seconds[:, :1])


def _direction(values: Floats) -> Floats:
    """The difference of the places two before and two after, on a closed line."""
    closed = values[:-1]
    around = np.roll(closed, -2) - np.roll(closed, 2)
    return np.append(around, around[0])
