"""The motor's speed for each m/s of the car, where a second source tells how fast the car is.

The best source is a pose with a heading, then a receiver's speed over ground, positions alone, and last the
speed that the motor's own driver calculates: it says with which gain, and no more.

With a heading, the way between two positions is the chord, along the mean of both headings, and longer by the
arc of the turn between them. Noise of a position adds nothing to it, unlike to the length of the path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_analysis.drives.building import with_derived
from iort_analysis.drives.cleaning import pause_us
from iort_analysis.drives.drive import Drive
from iort_analysis.mining.paths import path_of
from iort_analysis.results import attempt
from iort_analysis.statistics.distributions import sides
from iort_analysis.statistics.fitting import Fit, fit
from iort_analysis.statistics.signals import Array
from iort_contract.catalog.derived import Vehicle

# Windows in which motor and car are compared, and the distance that both need at least.
_WINDOW_S, _LEAST_M, _LEAST_DRIVE_M = 1.0, 0.3, 20.0
# A position that is this close to the motor's distance was calculated from it.
_SAME_M = 5e-4
# Speeds in m/s, by the last parts of their names: of a receiver, and calculated from the motor's, whose gain
# somebody has entered: half the interval of what a wheel differs from it.
_OVER_GROUND, _CALCULATED = ("gnss_gVel",), ("twist.twist.linear.x", "speed_meters_per_sec")
_ENTERED = 0.03
# Positions alone cut corners, by some share of the way.
_CUT = 0.01


def fit_gain(drive: Drive) -> Fit:
    """The fit whose only coefficient is the gain in erpm per m/s, over the drive; raises `NoResultError`."""
    (speed,) = drive.motor("speed", reason="needs the motor's speed")
    ways: list[Callable[[], Fit | None]] = [
        lambda: _by_pose(drive, speed),
        lambda: _by_speed(drive, speed, _OVER_GROUND, 0.0),
        lambda: _by_positions(drive, speed),
        lambda: _by_speed(drive, speed, _CALCULATED, _ENTERED),
    ]
    reasons = []
    for way in ways:
        found = attempt(way)
        if isinstance(found, Fit):
            return found
        if found is not None:
            reasons.append(found)
    none = "needs a second source of speed, such as a stream with the car's pose or positions"
    raise NoResultError(reasons[0] if reasons else none)


def with_gain(drive: Drive) -> Drive:
    """The drive; one of a car whose gain nobody has registered with the gain that the drive itself tells."""
    if drive.vehicle is not None or drive.vesc is None:
        return drive
    try:
        vehicle = Vehicle(float(fit_gain(drive).coefficients[0]))
    except NoResultError:
        return drive
    return replace(drive, vehicle=vehicle, samples=with_derived(drive.samples, drive.vesc, vehicle))


def _by_speed(drive: Drive, speed: Array, names: tuple[str, ...], error: float) -> Fit | None:
    """By the first of these fields of a speed, whose gain has an ``error`` of its own; None without one."""
    columns = drive.samples.columns
    for ending in names:
        for name in sorted(columns):
            if name.endswith(f".{ending}") and not bool(np.isnan(columns[name]).all()):
                return _compared(drive, speed, columns[name], error)
    return None


def _compared(drive: Drive, speed: Array, mps: Array, error: float) -> Fit:
    times_us = drive.samples.times_us
    grid_us = np.arange(times_us[0], times_us[-1], round(_WINDOW_S * 1e6))
    turned, way_m = (_integral(drive, values, grid_us) for values in (speed, mps))
    way_m[np.abs(way_m) < _LEAST_M] = np.nan
    return _of_way(turned, way_m, error)


def _by_positions(drive: Drive, speed: Array) -> Fit | None:
    """By the distance between positions that have no heading; None without them."""
    path = attempt(path_of, drive)
    if isinstance(path, str) or (drive.pose and "heading" in drive.streams[drive.pose].columns):
        return None
    times_us = path.start_us + np.round(path.seconds * 1e6).astype(np.int64)
    return _of_way(_integral(drive, np.abs(speed), times_us), np.diff(path.passed_m), _CUT)


def _of_way(turned: Array, way_m: Array, error: float) -> Fit:
    """The gain by the motor's way in erpm seconds and the car's in metres, with an ``error`` as a share."""
    if float(np.nansum(np.abs(way_m))) < _LEAST_DRIVE_M:
        raise NoResultError(f"needs {_LEAST_DRIVE_M:g} m of driving with a second source of speed")
    found = fit([turned], way_m)
    if found is None or not found.coefficients[0]:
        raise NoResultError("the drive is too short for the gain")
    gain = 1 / found.coefficients
    entered = (error / sides() * gain) ** 2
    covariance, given = (of * gain**4 + entered for of in (found.covariance, found.given))
    return found._replace(coefficients=gain, covariance=covariance, given=given, moved=found.moved * gain**2)


def _by_pose(drive: Drive, speed: Array) -> Fit | None:
    """By the way along the heading of a pose; None without one."""
    if drive.pose is None:
        return None
    pose = drive.streams[drive.pose]
    if "heading" not in pose.columns:
        return None
    known = np.isfinite(pose.columns["x"] + pose.columns["y"] + pose.columns["heading"])
    times_us = pose.times_us[known]
    if len(times_us) < 2:
        raise NoResultError(f"the stream {drive.pose} has no positions")
    steps_m = _steps(*(pose.columns[name][known] for name in ("x", "y", "heading")))
    steps_m[np.diff(times_us) > pause_us(times_us)] = np.nan
    window = (times_us[:-1] - times_us[0]) // round(_WINDOW_S * 1e6)
    starts = np.flatnonzero(np.append(True, window[1:] != window[:-1]))
    way_m, took_s = np.add.reduceat(steps_m, starts), np.add.reduceat(np.diff(times_us), starts) / 1e6
    way_m[(np.abs(way_m) < _LEAST_M) | (took_s < _WINDOW_S / 2)] = np.nan
    if float(np.nansum(np.abs(way_m))) < _LEAST_DRIVE_M:
        raise NoResultError(f"needs {_LEAST_DRIVE_M:g} m of driving with a pose")
    # The motor's way in erpm seconds: what the gain turns metres into. It has next to no noise, and the
    # positions have: the way is fitted to the motor's, so that the noise makes nothing smaller.
    turned, cubes = (
        np.add.reduceat(_integral(drive, column, times_us), starts) for column in (speed, speed**3)
    )
    # Tyres slip by their force: what accelerates the car, and what the air takes.
    squares = np.interp(times_us, drive.samples.times_us, speed * np.abs(speed))
    slips = (np.diff(squares[np.append(starts, len(times_us) - 1)]), cubes)
    usable = np.isfinite(way_m + turned + cubes + slips[0])
    found = fit(
        [turned, *(slip - turned * slip[usable].sum() / turned[usable].sum() for slip in slips)],
        way_m,
        shared=True,
    )
    if found is None or not found.coefficients[0]:
        raise NoResultError("the drive is too short for the gain")
    if found.sigma < _SAME_M:
        raise NoResultError(
            f"the positions of {drive.pose} are calculated from the motor's speed, so they say nothing new"
        )
    gain = 1 / found.coefficients[:1]
    covariance, given = (of[:1, :1] * gain**4 for of in (found.covariance, found.given))
    return found._replace(
        coefficients=gain, covariance=covariance, given=given, moved=found.moved[:, :1] * gain**2
    )


def _steps(x: Array, y: Array, heading: Array) -> Array:
    """The way from each position to the next, negative in reverse."""
    turn = np.remainder(np.diff(heading) + np.pi, 2 * np.pi) - np.pi
    middle = heading[:-1] + turn / 2
    chord = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    return np.asarray(chord / np.sinc(turn / (2 * np.pi)), dtype=np.float64)


def _integral(drive: Drive, values: Array, times_us: NDArray[np.int64]) -> Array:
    """The integral of values of the drive's samples between each two times; NaN where they are not known."""
    samples_us = drive.samples.times_us
    took_s = np.diff(samples_us) / 1e6
    parts = (values[1:] + values[:-1]) / 2 * took_s
    parts[np.diff(samples_us) > pause_us(samples_us)] = np.nan
    unknown = np.append(0.0, np.cumsum(np.isnan(parts)))
    total = np.append(0.0, np.cumsum(np.nan_to_num(parts)))
    since = times_us - samples_us[0]
    at, lost = (np.interp(since, samples_us - samples_us[0], column) for column in (total, unknown))
    return np.where(np.diff(lost) > 0, np.nan, np.diff(at))
