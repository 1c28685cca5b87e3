"""Laps, by a gate across the positions, else by the pattern of the drive: time, distance, energy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis import AnalysisError, NoResultError
from iort_analysis.drives.drive import Drive
from iort_analysis.mining.paths import Crossings, Gate, Path, find_gate, path_of
from iort_analysis.mining.patterns import find_pattern, odometer
from iort_analysis.results import Mined, Table, attempt
from iort_analysis.statistics.distributions import mean_of, sides
from iort_analysis.statistics.signals import Array
from iort_contract.catalog.analysis import LAPS_TABLE, PARAMETERS, PLACES_TABLE
from iort_contract.messages.analysis import Estimate

# The places of a lap: a quarter of a metre apart in a hall.
PLACES = 200
# Each step lands closer to the line across the place; the ways of two laps differ little.
_STEPS = 4
# A speed is that between the places so far before and after: of neighbours it would be noise.
_AROUND = 2


class Places(NamedTuple):
    """The same places in each lap: their distances in the reference lap, and for every lap (a row) the time
    since its start."""

    place_m: Array
    since_s: Array

    @property
    def speed_mps(self) -> Array:
        """The speed around each place, along the reference lap's line."""
        places = np.arange(len(self.place_m))
        before, after = np.maximum(places - _AROUND, 0), np.minimum(places + _AROUND, places[-1])
        seconds = np.maximum(self.since_s[:, after] - self.since_s[:, before], 1e-6)
        speed: Array = (self.place_m[after] - self.place_m[before]) / seconds
        return speed


def by_position(path: Path, starts_m: Array, ends_m: Array, reference: int) -> Places:
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


def _direction(values: Array) -> Array:
    """The difference of the places two before and two after, on a closed line."""
    closed = values[:-1]
    around = np.roll(closed, -2) - np.roll(closed, 2)
    return np.append(around, around[0])


# The laps of a drive, how they were found, and what each took.

_LEAST_LAPS = 2
_LEAST_CONFIDENCE = 0.5
# A lap's energy is known if so much of its time has a voltage and a current.
_LEAST_COVERED = 0.95
_LONGEST_GAP_S = 1.0


@dataclass(frozen=True)
class Laps:
    """The laps of a drive in order of time, all arrays of one value a lap.

    ``method`` says whether they are by crossing a ``gate`` or by the ``pattern`` of the drive. ``complete``
    is false for a lap that does not fit the others, such as one across the grass. ``jitter_s`` is the
    standard deviation of a bound's time. ``distance_m`` is NaN if the car's parameters are not known, and
    ``energy_wh`` if the battery is not.
    """

    method: str
    confidence: float
    gate: Gate | None
    jitter_s: float
    start_us: NDArray[np.int64]
    time_s: Array
    distance_m: Array
    energy_wh: Array
    complete: NDArray[np.bool_]
    places: Places


def find_laps(drive: Drive) -> Laps:
    """The laps of a drive; raises `NoResultError`."""
    path = attempt(path_of, drive)
    if isinstance(path, str):
        try:
            return _by_pattern(drive)
        except NoResultError as error:
            raise NoResultError(f"{path}, and {error}") from error
    crossed = find_gate(path)
    if crossed is None:
        raise NoResultError("the car never came back to a place in the same direction")
    if crossed.complete.sum() < _LEAST_LAPS or crossed.confidence < _LEAST_CONFIDENCE:
        back, laps = len(crossed.complete), int(crossed.complete.sum())
        raise NoResultError(f"the car came back to a place {back} times, {laps} of them by the same way")
    return _by_gate(drive, path, crossed)


def _by_gate(drive: Drive, path: Path, crossed: Crossings) -> Laps:
    starts, ends, complete = crossed.passed_m[:-1], crossed.passed_m[1:], crossed.complete
    bounds = path.seconds_at(crossed.passed_m)
    time_s = np.diff(bounds)
    median = np.median(time_s[complete])
    reference = int(np.argmin(np.where(complete, np.abs(time_s - median), np.inf)))
    places = by_position(path, starts, ends, reference)
    speed = float(np.median(places.speed_mps[complete][:, 0]))
    return Laps(
        "gate",
        crossed.confidence,
        crossed.gate,
        path.noise_m / max(speed, 1e-6),
        path.start_us + np.round(bounds[:-1] * 1e6).astype(np.int64),
        time_s,
        ends - starts,
        _energy_wh(drive, (path.start_us - drive.samples.times_us[:1]) / 1e6 + bounds),
        complete,
        places,
    )


def _by_pattern(drive: Drive) -> Laps:
    way = odometer(drive)
    found = find_pattern(drive, way)
    complete = found.alike >= _LEAST_CONFIDENCE
    if complete.sum() < _LEAST_LAPS:
        raise NoResultError(f"the drive repeats itself only {int(complete.sum())} times")
    starts, ends = found.passed[:-1], found.passed[1:]
    passed = starts[:, None] + (ends - starts)[:, None] * np.linspace(0, 1, PLACES + 1)
    moving = np.append(True, np.diff(way.passed) > 0)
    seconds = np.interp(passed, way.passed[moving], way.seconds[moving])
    lengths = ends - starts if drive.vehicle is not None else np.full(len(starts), np.nan)
    return Laps(
        "pattern",
        float(np.clip(found.correlation, 0, 1)),
        None,
        found.jitter_s,
        int(drive.samples.times_us[0]) + np.round(found.seconds[:-1] * 1e6).astype(np.int64),
        np.diff(found.seconds),
        lengths,
        _energy_wh(drive, found.seconds),
        complete,
        Places(np.linspace(0, float(np.median(lengths[complete])), PLACES + 1), seconds - seconds[:, :1]),
    )


def _energy_wh(drive: Drive, bounds: Array) -> Array:
    """The energy out of the battery between bounds, which are seconds of the drive."""
    volts, amps = drive.of(drive.vesc, "voltage_input"), drive.of(drive.vesc, "current_input")
    if volts is None or amps is None:
        return np.full(len(bounds) - 1, np.nan)
    seconds, watts = drive.seconds, (volts * amps).astype(np.float64)
    elapsed, mean = np.diff(seconds), (watts[1:] + watts[:-1]) / 2
    known = (elapsed <= _LONGEST_GAP_S) & np.isfinite(mean)

    def between(steps: Array) -> Array:
        """The sum of steps between samples over each lap."""
        return np.diff(np.interp(bounds, seconds, np.append(0.0, np.cumsum(steps))))

    covered = between(np.where(known, elapsed, 0.0)) / np.diff(bounds)
    energy = between(np.where(known, mean * elapsed, 0.0) / 3600)
    return np.where(covered >= _LEAST_COVERED, energy, np.nan)


def speed_mps(drive: Drive, laps: Laps) -> Array:
    """The speed at the places of each lap: by the motor, or without the car's parameters by the positions."""
    erpm = drive.of(drive.vesc, "speed")
    if erpm is None or drive.vehicle is None:
        return laps.places.speed_mps
    known = np.flatnonzero(np.isfinite(erpm))
    speed = np.abs(drive.mps(erpm[known]))
    starts = (laps.start_us - drive.samples.times_us[0]) / 1e6
    found: Array = np.interp(starts[:, None] + laps.places.since_s, drive.seconds[known], speed)
    return found


def best(laps: Laps) -> int:
    """The index of the fastest complete lap."""
    return int(np.argmin(np.where(laps.complete, laps.time_s, math.inf)))


# Laps, by a gate across the positions, else by the pattern of the drive: time, distance, energy.

# What is above zero in every lap; and how sure laps are whose interval says otherwise.
_POSITIVE, _UNSURE = ("lap_best_s", "lap_mean_s", "lap_distance_m"), 0.5
_NAMES = ("lap_best_s", "lap_mean_s", "lap_distance_m", "lap_energy_wh", "lap_energy_wh_per_km")


def mine(drive: Drive) -> Mined:
    """The laps of a drive."""
    found = attempt(find_laps, drive)
    if isinstance(found, str):
        return Mined(missing=dict.fromkeys(_NAMES, f"no laps: {found}"))
    estimates, speed = dict(_estimates(found)), speed_mps(drive, found)
    times = found.time_s[found.complete]
    spread = f"{len(times)} of {times.min():.1f} s to {times.max():.1f} s"
    # A mean that may as well be below zero is none: such laps differ as much as ways that are no laps.
    unsure = [name for name in _POSITIVE if name in estimates and estimates[name].low <= 0]
    if unsure:
        found = replace(found, confidence=min(found.confidence, _UNSURE))
    missing = {
        name: "needs the car's parameters"
        if name == "lap_distance_m"
        else "needs voltage and current of the battery"
        for name in _NAMES
        if name not in estimates
    }
    missing |= dict.fromkeys(unsure, f"the laps differ too much: {spread}")
    return Mined(
        {name: one for name, one in estimates.items() if name not in unsure},
        missing,
        tables={LAPS_TABLE: _laps_table(found, speed), PLACES_TABLE: _places_table(found, speed)},
    )


def _estimates(laps: Laps) -> Iterator[tuple[str, Estimate]]:
    times = laps.time_s[laps.complete]
    either_s = sides() * math.sqrt(2) * laps.jitter_s
    least = float(times.min())
    yield "lap_best_s", Estimate(least, least - either_s, least + either_s, "s")
    for name, values in (
        ("lap_mean_s", laps.time_s),
        ("lap_distance_m", laps.distance_m),
        ("lap_energy_wh", laps.energy_wh),
        ("lap_energy_wh_per_km", _per_km(laps)),
    ):
        known = values[laps.complete]
        known = known[np.isfinite(known)]
        if len(known) >= 2:
            yield name, Estimate(*mean_of(known), PARAMETERS[name].unit)


def _per_km(laps: Laps) -> Array:
    return laps.energy_wh / laps.distance_m * 1000


def _laps_table(laps: Laps, speed: Array) -> Table:
    n = len(laps.time_s)
    return {
        "lap": np.arange(1, n + 1),
        "start_us": laps.start_us,
        "time_s": laps.time_s,
        "distance_m": laps.distance_m,
        "energy_wh": laps.energy_wh,
        "energy_wh_per_km": _per_km(laps),
        "mean_speed_mps": laps.distance_m / laps.time_s,
        "top_speed_mps": speed.max(axis=1),
        "complete": laps.complete,
        "best": np.arange(n) == best(laps),
        "method": np.full(n, laps.method, dtype=object),
        "confidence": np.full(n, laps.confidence),
    }


def _places_table(laps: Laps, speed: Array) -> Table:
    """When each lap passed each place: the difference of two laps is their delta-time."""
    n, places = laps.places.since_s.shape
    return {
        "lap": np.repeat(np.arange(1, n + 1), places),
        "place_m": np.tile(laps.places.place_m, n),
        "since_s": np.round(laps.places.since_s.ravel(), 4),
        "speed_mps": np.round(speed.ravel(), 3),
    }


# Two laps at the same places of the track.


def compare(places: Table, one: int, other: int) -> Table:
    """The delta-time of two laps against distance: positive where ``other`` is behind ``one``.

    ``places`` is the table of when each lap passed each place. Raises `AnalysisError` for a lap that is not
    there.
    """
    rows = {lap: np.flatnonzero(places["lap"] == lap) for lap in (one, other)}
    for lap, found in rows.items():
        if not len(found):
            laps = int(np.max(places["lap"], initial=0))
            raise AnalysisError(f"lap must be from 1 to {laps}, got {lap}")
    first, second = rows[one], rows[other]
    return {
        "place_m": places["place_m"][first],
        "delta_s": places["since_s"][second] - places["since_s"][first],
        "one_mps": places["speed_mps"][first],
        "other_mps": places["speed_mps"][second],
    }
