"""Laps without positions: a drive that repeats itself has the same pattern of speed, current and steering
again after each lap."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from iort_analysis import NoResultError
from iort_analysis.drives.drive import Drive
from iort_analysis.statistics.signals import Array, bridged, summed

# Fields of any stream that tell the car's turns.
_TURNS = ("steering_angle", "angular_velocity.z", "angular.z", "gyro_z", "data")
_MOTION = ("speed", "current_motor")
_MOST_STEPS = 16_384
# The time between two samples that still belongs to a drive.
_LONGEST_GAP_S = 1.0
_SHORTEST_LAP_S = 3.0
_LEAST_LAPS = 3
# A pattern that correlates less with itself is no lap.
_LEAST_CORRELATION = 0.4
# A lap may be this much longer or shorter on the odometer than the usual one.
_SLACK = 0.06


class Pattern(NamedTuple):
    """Laps by their pattern: bounds of each on the odometer and in seconds, and its likeness to the mean lap.

    ``correlation`` is the drive's with itself, one lap later. ``jitter_s`` is the standard deviation of a
    bound's time.
    """

    passed: Array
    seconds: Array
    alike: Array
    correlation: float
    jitter_s: float


class Odometer(NamedTuple):
    """The way of a drive by the motor's speed, in metres or, without the car's parameters, in turns."""

    seconds: Array
    passed: Array


def odometer(drive: Drive) -> Odometer:
    """The distance by the motor's speed; raises `NoResultError` without a speed."""
    (erpm,) = drive.motor("speed", reason="none has a motor's speed")
    speed = np.abs(erpm / 60 if drive.vehicle is None else drive.mps(erpm))
    seconds = drive.seconds
    return Odometer(seconds, summed(seconds, speed, _LONGEST_GAP_S))


def find_pattern(drive: Drive, way: Odometer) -> Pattern:
    """The laps of a drive that repeats itself; raises `NoResultError`."""
    signals = _signals(drive)
    moving = np.append(True, np.diff(way.passed) > 0)
    if not signals or moving.sum() < 10 * _LEAST_LAPS:
        raise NoResultError("the car hardly moved")
    n = min(_MOST_STEPS, int(moving.sum()))
    grid = np.linspace(0.0, way.passed[-1], n)
    resampled = [np.interp(grid, way.passed[moving], signal[moving]) for signal in signals]
    waves = np.array([(w - w.mean()) / w.std() for w in resampled if w.std() > 0])
    if not len(waves):
        raise NoResultError("neither speed nor current changes")
    mean_speed = way.passed[-1] / max(float(np.diff(way.seconds)[moving[1:]].sum()), 1e-6)
    shortest = max(10, round(_SHORTEST_LAP_S * mean_speed / (grid[1] - grid[0])))
    lag, correlation = _period(waves, shortest, n // _LEAST_LAPS)
    if lag == 0:
        raise NoResultError("the drive is too short for three laps")
    if correlation < _LEAST_CORRELATION:
        raise NoResultError(
            f"the drive does not repeat itself: its correlation with itself is {correlation:.2f} at most"
        )
    bounds, alike = _bounds(waves, lag)
    if len(alike) < _LEAST_LAPS - 1:
        raise NoResultError("the drive is too short for three laps")
    passed = np.interp(bounds, np.arange(n), grid)
    seconds = np.interp(passed, way.passed[moving], way.seconds[moving])
    jitter_s = float(np.std(np.diff(passed)) / np.sqrt(2) / mean_speed)
    return Pattern(passed, seconds, alike, correlation, jitter_s)


def _signals(drive: Drive) -> list[Array]:
    named = [drive.of(drive.vesc, name) for name in _MOTION]
    turns = [
        column for name, column in drive.samples.columns.items() if name.partition(".")[2].endswith(_TURNS)
    ]
    known = [column for column in (*named, *turns) if column is not None and np.isfinite(column).any()]
    return [bridged(column.astype(np.float64)) for column in known]


def _period(waves: Array, shortest: int, longest: int) -> tuple[int, float]:
    """The first lag at which the drive is most like itself, and the correlation there; 0 without one."""
    n = waves.shape[1]
    if longest <= shortest + 2:
        return 0, 0.0
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(waves, size, axis=1)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=1)[:, : longest + 2].mean(axis=0)
    correlation = products / (n - np.arange(longest + 2))
    inner = correlation[shortest : longest + 1]
    peaks = np.flatnonzero(
        (inner >= correlation[shortest - 1 : longest]) & (inner > correlation[shortest + 1 : longest + 2])
    )
    if not len(peaks):
        return 0, 0.0
    heights = inner[peaks]
    # Two laps are as alike as one.
    first = peaks[np.flatnonzero(heights >= 0.9 * heights.max())[0]]
    return int(first + shortest), float(inner[first])


def _bounds(waves: Array, lag: int) -> tuple[Array, Array]:
    """The bounds of the laps on the grid, and each lap's correlation with the mean one.

    A lap begins where the mean lap is fastest. Each bound is where the drive around it is most like the mean
    lap around its start.
    """
    n = waves.shape[1]
    laps = n // lag
    mean = waves[:, : laps * lag].reshape(len(waves), laps, lag).mean(axis=1)
    begin = int(np.argmax(np.convolve(np.tile(mean[0], 3), np.ones(lag // 20 + 1), "same")[lag : 2 * lag]))
    half, slack = lag // 2, max(2, round(lag * _SLACK))
    for _ in range(3):
        places = _follow(waves, np.roll(mean, half - begin, axis=1), begin, lag, slack)
        around = np.array(
            [waves[:, p - half : p - half + lag] for p in places if half <= p <= n - lag + half]
        )
        if len(around) < _LEAST_LAPS:
            break
        mean = np.roll(around.mean(axis=0), begin - half, axis=1)
    mean = np.roll(mean, -begin, axis=1)
    alike = [_likeness(waves, mean, bounds) for bounds in pairwise(places)]
    return np.array(places, dtype=np.float64), np.array(alike)


def _likeness(waves: Array, mean: Array, bounds: tuple[int, int]) -> float:
    """The correlation of a lap with the mean lap."""
    grid = np.arange(waves.shape[1])
    at = np.linspace(*bounds, mean.shape[1], endpoint=False)
    pairs = zip(mean, waves, strict=True)
    return float(np.mean([np.corrcoef(usual, np.interp(at, grid, wave))[0, 1] for usual, wave in pairs]))


def _follow(waves: Array, wanted: Array, begin: int, lag: int, slack: int) -> list[int]:
    """The place of each lap's start: near one lap after the last one, where the drive is most like it."""
    n, half = waves.shape[1], lag // 2
    energy = float((wanted**2).sum())
    places: list[int] = []
    expected = begin if begin >= half else begin + lag
    while expected + lag - half + slack < n:
        shifts = range(max(half, expected - slack), expected + slack + 1)
        fits = [float((waves[:, p - half : p - half + lag] * wanted).sum()) / energy for p in shifts]
        places.append(shifts[int(np.argmax(fits))])
        expected = places[-1] + lag
    return places
