"""The way of a car over the ground, and the gate across it that it passes once a lap."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_analysis.drives.cleaning import pause_us
from iort_analysis.drives.drive import Drive
from iort_analysis.samples.positions import accuracy_m, fixes, local_metres, position_fields
from iort_analysis.statistics.signals import MAD_TO_SIGMA, Array

_LEAST_POSITIONS = 30
# Positions closer together than this many times their noise would add the noise to the distance.
_APART_NOISES = 20
# The differences of four positions in a row, whose variance is 20 times a position's.
_THIRD_DIFFERENCE = math.sqrt(20)
# A receiver that is less sure of its position than this does not tell on which side of a street the car is.
_WORST_M = 10.0
# An area this many times as large as the positions' errors is one in which the car moved.
_LEAST_EXTENT = 5.0
# A car moves so much further than its motor turns at most, also with a gain that is somewhat off; and where
# nobody knows the motor's speed, it is no faster than this. A position is as far off as the receiver says, a
# few times; without a word of it, by this.
_SLIDES, _FASTEST_MPS, _ERRORS, _SLACK_M = 1.5, 60.0, 3.0, 1.0
# So many of the positions must be where the car can be.
_LEAST_PLAUSIBLE = 0.5


@dataclass(frozen=True)
class Path:
    """Positions some distance apart, so that neither noise nor a stand adds to the way.

    ``seconds`` counts from the drive's first position; ``passed_m`` is the distance along the way.
    ``noise_m`` is the standard deviation of a measured position, and ``extent_m`` the diagonal of the area.
    """

    start_us: int
    seconds: Array
    x_m: Array
    y_m: Array
    noise_m: float
    extent_m: float

    @cached_property
    def passed_m(self) -> Array:
        """The distance from the first position."""
        steps = np.hypot(np.diff(self.x_m), np.diff(self.y_m))
        return np.concatenate([[0.0], np.cumsum(steps)])

    def seconds_at(self, passed_m: Array) -> Array:
        """The times at distances along the way."""
        return np.interp(passed_m, self.passed_m, self.seconds)

    def position_at(self, passed_m: Array) -> tuple[Array, Array]:
        """The positions at distances along the way."""
        return np.interp(passed_m, self.passed_m, self.x_m), np.interp(passed_m, self.passed_m, self.y_m)


def path_of(drive: Drive) -> Path:
    """The way of a drive by its stream of positions; raises `NoResultError`."""
    placed = {name: fields for name, b in drive.streams.items() if (fields := position_fields(b.columns))}
    stream = drive.pose if drive.pose in placed else min(placed, default=None)
    if stream is None:
        raise NoResultError("no stream has a position")
    block, fields = drive.streams[stream], placed[stream]
    accuracy = accuracy_m(block.columns, fields)
    if fields.degrees:
        latitude, longitude = fixes(block.columns, fields)
        known = np.flatnonzero(~np.isnan(latitude))
        if not len(known):
            raise NoResultError(f"no position in {stream} has a fix")
        x, y = local_metres(latitude, longitude, (float(latitude[known[0]]), float(longitude[known[0]])))
    else:
        x, y = (block.columns[name].astype(np.float64) for name in fields.names)
    there = np.isfinite(x) & np.isfinite(y)
    if accuracy is not None:
        with np.errstate(invalid="ignore"):
            there &= ~(accuracy > _WORST_M)
        if not there.any():
            raise NoResultError(f"{stream} is right to {_WORST_M:g} m at no time")
    known = np.flatnonzero(there)
    times = block.times_us[known]
    later = np.append(True, times[1:] > times[:-1])[: len(known)]
    known, times = known[later], times[later]
    if len(known) < _LEAST_POSITIONS:
        raise NoResultError(f"{stream} has {len(known)} positions, at least {_LEAST_POSITIONS} are needed")
    x, y = x[known], y[known]
    errors_m = None if accuracy is None else accuracy[known]
    error_m = 0.0 if errors_m is None else float(np.nan_to_num(np.nanmedian(errors_m)))
    reach_m = _reach_m(drive, times)
    plausible = _plausible(x, y, reach_m, max(_SLACK_M, _ERRORS * error_m))
    if plausible.mean() < _LEAST_PLAUSIBLE:
        raise NoResultError(
            f"{1 - plausible.mean():.0%} of the positions of {stream} are further apart than the car can "
            "move: they jump, or the gain is not the car's"
        )
    x, y, times = x[plausible], y[plausible], times[plausible]
    noise_m = float(np.hypot(_noise(x), _noise(y))) / math.sqrt(2)
    spans = [np.diff(np.percentile(each, [1, 99]))[0] for each in (x, y)]
    extent_m = float(np.hypot(*spans))
    kept = _apart(x, y, max(_APART_NOISES * noise_m, extent_m / 500))
    if len(kept) < _LEAST_POSITIONS:
        raise NoResultError("the car hardly moved")
    if extent_m < _LEAST_EXTENT * error_m:
        raise NoResultError(
            f"the positions of {stream} are within {extent_m:.3g} m, and right to {error_m:.3g} m"
        )
    noise_m = max(noise_m, error_m)
    path = Path(int(times[0]), (times[kept] - times[0]) / 1e6, x[kept], y[kept], noise_m, extent_m)
    if path.passed_m[-1] > reach_m[-1] + extent_m:
        way_m = path.passed_m[-1]
        raise NoResultError(
            f"the positions of {stream} move {way_m:.0f} m, and the motor {reach_m[-1]:.0f} m at most"
        )
    return path


def _reach_m(drive: Drive, times: NDArray[np.int64]) -> Array:
    """How far the car can have moved since the first of some times, by the motor's speed."""
    seconds = (times - times[0]) / 1e6
    speed = drive.of(drive.vesc, "speed")
    if drive.vehicle is None or speed is None:
        return np.asarray(_FASTEST_MPS * seconds, dtype=np.float64)
    mps = np.abs(drive.mps(speed))
    mps = np.where(np.isfinite(mps), _SLIDES * mps, _FASTEST_MPS)
    samples_us = drive.samples.times_us
    took = np.diff(samples_us) / 1e6
    # In a pause of the motor's samples nobody knows.
    steps = np.where(np.diff(samples_us) > pause_us(samples_us), _FASTEST_MPS, np.maximum(mps[1:], mps[:-1]))
    moved = np.append(0.0, np.cumsum(steps * took))
    first, last = samples_us[0], samples_us[-1]
    outside = np.maximum(first - times, 0) - np.maximum(times - last, 0)
    reached = np.interp(times - first, samples_us - first, moved) - _FASTEST_MPS * outside / 1e6
    return np.asarray(reached - reached[0], dtype=np.float64)


def _plausible(x: Array, y: Array, reach_m: Array, slack_m: float) -> NDArray[np.bool_]:
    """Which positions the car can have had: those of the longest stretch without a jump, and of each stretch
    before and after it to which the car can have moved meanwhile."""
    away = np.hypot(np.diff(x), np.diff(y)) > np.diff(reach_m) + slack_m
    edges = np.concatenate([[0], np.flatnonzero(away) + 1, [len(x)]])
    stretches = list(pairwise(edges.tolist()))
    main = int(np.argmax(np.diff(edges)))
    found = np.zeros(len(x), dtype=np.bool_)
    for onwards, ordered in ((True, stretches[main:]), (False, stretches[main::-1])):
        at: int | None = None
        for first, last in ordered:
            near, far = (first, last - 1) if onwards else (last - 1, first)
            if at is None or math.hypot(x[near] - x[at], y[near] - y[at]) <= (
                abs(reach_m[near] - reach_m[at]) + slack_m
            ):
                found[first:last] = True
                at = far
    return found


def _noise(values: Array) -> float:
    """The noise of positions that are sampled faster than the car changes its acceleration."""
    return float(np.median(np.abs(np.diff(values, 3)))) * MAD_TO_SIGMA / _THIRD_DIFFERENCE


def _apart(x: Array, y: Array, least_m: float) -> NDArray[np.intp]:
    """The indexes of positions that are at least so far from the one kept before."""
    kept, least2 = [0], least_m**2
    at_x, at_y = x[0], y[0]
    for i, (here_x, here_y) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        if (here_x - at_x) ** 2 + (here_y - at_y) ** 2 >= least2:
            kept.append(i)
            at_x, at_y = here_x, here_y
    return np.array(kept, dtype=np.intp)


# A gate across the way, which the car passes once a lap and in one direction.

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
    passed_m: Array
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


def crossings(path: Path, gate: Gate) -> Array:
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


def _laps(path: Path, passed: Array, most_aside_m: float) -> NDArray[np.bool_]:
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


def _speed_mps(path: Path, passed: Array) -> float:
    """The median speed around the crossings."""
    around = path.passed_m[-1] / len(path.passed_m)
    seconds = path.seconds_at(passed + around) - path.seconds_at(passed - around)
    return float(2 * around / max(np.median(seconds), 1e-6))
