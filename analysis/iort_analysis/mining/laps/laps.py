"""The laps of a drive, how they were found, and what each took."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.laps.gate import Crossings, Gate, find_gate
from iort_analysis.mining.laps.path import Floats, Path, path_of
from iort_analysis.mining.laps.pattern import find_pattern, odometer
from iort_analysis.mining.laps.places import PLACES, Places, by_position

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
    time_s: Floats
    distance_m: Floats
    energy_wh: Floats
    complete: NDArray[np.bool_]
    places: Places


def find_laps(drive: Drive) -> Laps | str:
    """The laps of a drive; a text says why there are none."""
    path = path_of(drive)
    if isinstance(path, str):
        return _by_pattern(drive, path)
    crossed = find_gate(path)
    if crossed is None:
        return "the car never came back to a place in the same direction"
    if crossed.complete.sum() < _LEAST_LAPS or crossed.confidence < _LEAST_CONFIDENCE:
        back, laps = len(crossed.complete), int(crossed.complete.sum())
        return f"the car came back to a place {back} times, {laps} of them by the same way"
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


def _by_pattern(drive: Drive, why: str) -> Laps | str:
    way = odometer(drive)
    if way is None:
        return f"{why}, and none has a motor's speed"
    found = find_pattern(drive, way)
    if isinstance(found, str):
        return f"{why}, and {found}"
    complete = found.alike >= _LEAST_CONFIDENCE
    if complete.sum() < _LEAST_LAPS:
        return f"{why}, and the drive repeats itself only {int(complete.sum())} times"
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


def _energy_wh(drive: Drive, bounds: Floats) -> Floats:
    """The energy out of the battery between bounds, which are seconds of the drive."""
    volts, amps = drive.of(drive.vesc, "voltage_input"), drive.of(drive.vesc, "current_input")
    if volts is None or amps is None:
        return np.full(len(bounds) - 1, np.nan)
    seconds, watts = drive.seconds, (volts * amps).astype(np.float64)
    elapsed, mean = np.diff(seconds), (watts[1:] + watts[:-1]) / 2
    known = (elapsed <= _LONGEST_GAP_S) & np.isfinite(mean)
    between = _summed(seconds, bounds)
    covered = between(np.where(known, elapsed, 0.0)) / np.diff(bounds)
    energy = between(np.where(known, mean * elapsed, 0.0) / 3600)
    return np.where(covered >= _LEAST_COVERED, energy, np.nan)


def _summed(seconds: Floats, bounds: Floats) -> Callable[[Floats], Floats]:
    """What sums steps between samples over each lap."""

    def between(steps: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum(steps)])
        return np.diff(np.interp(bounds, seconds, total))

    return between


def speed_mps(drive: Drive, laps: Laps) -> Floats:
    """The speed at the places of each lap: by the motor, or without the car's parameters by the positions."""
    erpm, vehicle = drive.of(drive.vesc, "speed"), drive.vehicle
    if erpm is None or vehicle is None:
        return laps.places.speed_mps
    known = np.flatnonzero(np.isfinite(erpm))
    speed = np.abs((erpm[known] - vehicle.speed_to_erpm_offset) / vehicle.speed_to_erpm_gain)
    starts = (laps.start_us - drive.samples.times_us[0]) / 1e6
    found: Floats = np.interp(starts[:, None] + laps.places.since_s, drive.seconds[known], speed)
    return found


def best(laps: Laps) -> int:
    """The index of the fastest complete lap."""
    return int(np.argmin(np.where(laps.complete, laps.time_s, math.inf)))
