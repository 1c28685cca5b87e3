"""A gate across the way, which the car passes once a lap and in one direction."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.mining.laps.path import Floats, Path

# A gate is twice as wide as this share of the area's diagonal, and a place as long.
_WIDTH_SHARE = 1 / 12
_OCTANTS = 8
_MOST_PLACES = 120
# Ways between two crossings that differ by less are as long as each other.
_SAME_LENGTH = 0.1
# Crossings are a lap only if they are this many distances of positions apart.
_LEAST_STEPS = 10
_SHAPE_POINTS = 40


class Gate(NamedTuple):
    """A line across the way at a point; a car passes it towards ``heading_rad``."""

    x_m: float
    y_m: float
    heading_rad: float
    half_width_m: float


class Crossings(NamedTuple):
    """Where the way crosses a gate, as distances along the way; ``complete`` tells which of the ways between
    two crossings are laps of one track."""

    gate: Gate
    passed_m: Floats
    complete: NDArray[np.bool_]

    @property
    def confidence(self) -> float:
        """The share of ways between crossings that are laps."""
        return float(self.complete.mean()) if len(self.complete) else 0.0


def find_gate(path: Path) -> Crossings | None:
    """The gate with the most laps; None if the car never came back to a place in the same direction.

    Of gates with as many laps it is the one that the car passes fastest: there, the noise of a position
    changes the time least.
    """
    best: tuple[tuple[int, float], Crossings] | None = None
    most = 0
    found: list[tuple[int, float, Crossings]] = []
    for gate in _places(path):
        passed = crossings(path, gate)
        if len(passed) < 2:
            continue
        complete = _laps(path, passed, gate.half_width_m)
        laps = int(complete.sum())
        most = max(most, laps)
        found.append((laps, _speed_mps(path, passed), Crossings(gate, passed, complete)))
    for laps, speed_mps, crossed in found:
        # A gate that is passed twice a lap has as many laps, among others that are none.
        if laps < 0.9 * most:
            continue
        rank = (round(10 * crossed.confidence), speed_mps)
        if best is None or rank > best[0]:
            best = (rank, crossed)
    return None if best is None else best[1]


def crossings(path: Path, gate: Gate) -> Floats:
    """The distances along the way at which it crosses a gate in its direction."""
    cos, sin = math.cos(gate.heading_rad), math.sin(gate.heading_rad)
    x, y = path.x_m - gate.x_m, path.y_m - gate.y_m
    along, across = x * cos + y * sin, y * cos - x * sin
    before = np.flatnonzero((along[:-1] < 0) & (along[1:] >= 0))
    share = -along[before] / (along[before + 1] - along[before])
    beside = across[before] + share * (across[before + 1] - across[before])
    length = path.passed_m[before + 1] - path.passed_m[before]
    # Within 60 degrees of the direction.
    through = (np.abs(beside) <= gate.half_width_m) & (along[before + 1] - along[before] >= 0.5 * length)
    return (path.passed_m[before] + share * length)[through]


def _places(path: Path) -> list[Gate]:
    """Gates at the places and in the directions that the car passed most often."""
    size = path.extent_m * _WIDTH_SHARE
    dx, dy = np.gradient(path.x_m), np.gradient(path.y_m)
    heading = np.arctan2(dy, dx)
    octant = np.round(heading / (2 * np.pi / _OCTANTS)).astype(np.int64) % _OCTANTS
    column, row = (np.floor((v - v.min()) / size).astype(np.int64) for v in (path.x_m, path.y_m))
    place = (column * (int(row.max()) + 1) + row) * _OCTANTS + octant
    order = np.argsort(place, kind="stable")
    _, starts, counts = np.unique(place[order], return_index=True, return_counts=True)
    densest = np.argsort(-counts, kind="stable")[:_MOST_PLACES]
    gates = []
    for start, count in zip(starts[densest], counts[densest], strict=True):
        here = order[start : start + count]
        mean = np.arctan2(dy[here].mean(), dx[here].mean())
        gates.append(
            Gate(float(np.median(path.x_m[here])), float(np.median(path.y_m[here])), float(mean), size)
        )
    return gates


def _laps(path: Path, passed: Floats, most_aside_m: float) -> NDArray[np.bool_]:
    """Which ways between crossings have the usual length, and the usual shape."""
    lengths = np.diff(passed)
    usual = float(np.median(lengths))
    step = path.passed_m[-1] / (len(path.passed_m) - 1)
    alike = np.abs(lengths / usual - 1) < _SAME_LENGTH
    if usual < _LEAST_STEPS * step or not alike.any():
        return np.zeros(len(lengths), dtype=np.bool_)
    shares = np.linspace(0, 1, _SHAPE_POINTS)
    x, y = path.position_at(passed[:-1, None] + lengths[:, None] * shares)
    aside = np.hypot(x - np.median(x[alike], axis=0), y - np.median(y[alike], axis=0))
    near: NDArray[np.bool_] = np.sqrt((aside**2).mean(axis=1)) < most_aside_m
    return alike & near


def _speed_mps(path: Path, passed: Floats) -> float:
    """The median speed around the crossings."""
    around = path.passed_m[-1] / len(path.passed_m)
    seconds = path.seconds_at(passed + around) - path.seconds_at(passed - around)
    return float(2 * around / max(np.median(seconds), 1e-6))
