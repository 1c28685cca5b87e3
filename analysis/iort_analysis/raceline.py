"""The line of least curvature around a track, and the fastest speeds along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from iort_analysis import AnalysisError
from iort_analysis.statistics import quadratic
from iort_analysis.statistics.signals import Array
from iort_contract.track import Track

# The distance of points, as a share of the track's width, and the limits of their number.
_SPACING, _LEAST, _MOST = 0.2, 200, 1500
# Directions are those of the line smoothed over this many points, so that no noise turns them.
_SMOOTH = 3.0
# Lines across the track must not cross: how far they may go of the way to the centre of a curve.
_TO_CENTRE = 0.9


class TrackError(AnalysisError):
    """A track without a racing line; the text says why."""


@dataclass(frozen=True)
class Reference:
    """The centre line in points, an array of two columns in metres; the unit vectors to the left, and the
    bounds of the car's centre along them."""

    points: Array
    across: Array
    low: Array
    high: Array

    def line(self, offset: Array) -> Array:
        """The points of a line by its offsets to the left."""
        return self.points + offset[:, None] * self.across


def reference(track: Track, car_width_m: float) -> Reference:
    """The reference of a track, for a car that stays within its edges. Raises `TrackError`."""
    raw = np.column_stack([track.x_m, track.y_m])
    widths = np.column_stack([track.w_right_m, track.w_left_m])
    at = np.concatenate([[0.0], np.cumsum(_lengths(raw))])
    count = int(np.clip(at[-1] / (_SPACING * widths.sum(axis=1).mean()), _LEAST, _MOST))
    where = np.arange(count) * at[-1] / count
    points = np.column_stack([_hermite(where, at, column) for column in raw.T])
    # Widths are linear between points, as the edges are.
    right, left = (np.interp(where, at, np.append(column, column[0])) for column in widths.T)
    smooth = _smoothed(points)
    along = np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    bend = curvature(smooth)[0]
    low, high = car_width_m / 2 - right, left - car_width_m / 2
    with np.errstate(divide="ignore"):
        centre = _TO_CENTRE / np.abs(bend)
    low = np.where(bend < 0, np.maximum(low, -centre), low)
    high = np.where(bend > 0, np.minimum(high, centre), high)
    if (low >= high).any():
        worst = int(np.argmin(high - low))
        raise TrackError(
            f"the track must be wider than the car ({car_width_m:g} m) between its edges and the centres of "
            f"its curves, got {right[worst] + left[worst]:.3g} m "
            f"at x {points[worst, 0]:.3g} m, y {points[worst, 1]:.3g} m"
        )
    return Reference(points, across, low, high)


def curvature(points: Array) -> tuple[Array, Array]:
    """The curvature of a closed line at each point, 1/m and positive to the left, and the length that the
    point stands for."""
    ahead, behind = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    first, second = (ahead - behind) / 2, ahead - 2 * points + behind
    length = np.linalg.norm(first, axis=1)
    return (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / length**3, length


def _lengths(points: Array) -> Array:
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))


def _hermite(where: Array, at: Array, values: Array) -> Array:
    """Values of a closed line between its points, by cubics with the slope of their neighbours."""
    n = values.size
    i = np.clip(np.searchsorted(at, where, side="right") - 1, 0, n - 1)
    steps = np.diff(at)
    rise = (np.roll(values, -1) - values) / steps
    before = np.roll(rise, 1)
    # The parabola through three points.
    slopes = (before * steps + rise * np.roll(steps, 1)) / (steps + np.roll(steps, 1))
    h, j = steps[i], (i + 1) % n
    t = (where - at[i]) / h
    return np.asarray(
        values[i] * (2 * t**3 - 3 * t**2 + 1)
        + values[j] * (3 * t**2 - 2 * t**3)
        + h * (slopes[i] * (t**3 - 2 * t**2 + t) + slopes[j] * (t**3 - t**2))
    )


def _smoothed(points: Array) -> Array:
    """A closed line, smoothed by a bell of `_SMOOTH` points."""
    waves = np.fft.rfftfreq(points.shape[0])
    bell = np.exp(-2 * (np.pi * _SMOOTH * waves) ** 2)
    return np.fft.irfft(np.fft.rfft(points, axis=0) * bell[:, None], n=points.shape[0], axis=0)


# The line of least curvature: the integral of its square over the lap's length is the least.
#
# Source: Heilmeier, Wischnewski, Hermansdorfer, Betz, Lienkamp and Lohmann, Minimum curvature trajectory
# planning and control for an autonomous race car, Vehicle System Dynamics 58 (2020), equations 4 to 15. They
# linearise the curvature once, with splines; here it is linearised again at each step (Gauss-Newton), with
# differences of neighbouring points, which keeps the quadratic programme banded.

_STEPS, _ENOUGH, _HALVES = 40, 1e-6, 12
# Added to the Hessian's diagonal, relative to its mean: a shift of a whole circle changes no curvature.
_RIDGE = 1e-7


def least_curvature(track: Reference) -> Array:
    """The offsets to the left of the line of least curvature, in metres."""
    offset = np.clip(np.zeros_like(track.low), track.low, track.high)
    now = _cost(track, offset)
    for _ in range(_STEPS):
        rows, residual = _linear(track, offset)
        hessian, gradient = _normal(rows, residual)
        hessian[0] += _RIDGE * hessian[0].mean()
        move = quadratic.minimum(hessian, gradient, track.low - offset, track.high - offset)
        length = 1.0
        for _ in range(_HALVES):
            tried = _cost(track, offset + length * move)
            if tried < now:
                break
            length /= 2
        else:
            break
        offset = offset + length * move
        gained, now = now - tried, tried
        if gained < _ENOUGH * now:
            break
    return offset


def _cost(track: Reference, offset: Array) -> float:
    """The integral of the squared curvature, 1/m."""
    residual = _residual(track.line(offset))
    return float(residual @ residual)


def _residual(points: Array) -> Array:
    """What squares and sums to the integral: the curvature times the root of the length."""
    first, second, length = _differences(points)
    return np.asarray(_cross(first, second) / length**2.5)


def _linear(track: Reference, offset: Array) -> tuple[Array, Array]:
    """The residual, and its derivatives by the offset of the point behind, the point, and the one ahead."""
    first, second, length = _differences(track.line(offset))
    bend = _cross(first, second)
    rows = []
    for shift, d_first, d_second in ((1, -0.5, 1.0), (0, 0.0, -2.0), (-1, 0.5, 1.0)):
        across = np.roll(track.across, shift, axis=0)
        d_bend = _cross(d_first * across, second) + _cross(first, d_second * across)
        d_length = d_first * (first * across).sum(axis=1) / length
        rows.append(d_bend / length**2.5 - 2.5 * bend * d_length / length**3.5)
    return np.array(rows), bend / length**2.5


def _normal(rows: Array, residual: Array) -> tuple[Array, Array]:
    """J^T J as `banded.solve` takes it, and J^T r, for a J of three cyclic diagonals."""
    behind, here, ahead = rows
    diagonals = np.array(
        [
            here**2 + np.roll(ahead, 1) ** 2 + np.roll(behind, -1) ** 2,
            here * ahead + np.roll(behind * here, -1),
            np.roll(behind * ahead, -1),
        ]
    )
    gradient = here * residual + np.roll(ahead * residual, 1) + np.roll(behind * residual, -1)
    return diagonals, gradient


def _differences(points: Array) -> tuple[Array, Array, Array]:
    ahead, behind = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    first = (ahead - behind) / 2
    return first, ahead - 2 * points + behind, np.linalg.norm(first, axis=1)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


# The fastest speeds along a line, by the car's limits: a lap in a steady state at each point.
#
# Source: Heilmeier et al. (see line.py), section 5: the speed that the curve allows, then forward what the
# motor adds, then backward what the brakes take. The tyres have one friction circle for both directions.

_G = 9.81


# A slower car stands.
_SLOW_MPS = 0.01


class LimitsError(AnalysisError):
    """A car that does not get around the track; the text says why."""


@dataclass(frozen=True)
class Limits:
    """What a car can do. ``grip`` is the tyres' coefficient on this floor, ``power_w`` the motor's power at
    the wheels.

    The motor accelerates by at most ``accel_mps2``, the brakes by ``brake_mps2``. Rolling takes a force at
    any speed, the air one by the square of the speed.
    """

    mass_kg: float
    grip: float
    power_w: float
    accel_mps2: float
    brake_mps2: float
    speed_mps: float
    rolling_n: float = 0.0
    drag_n_s2_per_m2: float = 0.0


@dataclass(frozen=True)
class Profile:
    """Speeds along a closed line: at each point the way from the first one, the curvature, the speed, and
    the time since the first point."""

    at_m: Array
    curvature_1pm: Array
    speed_mps: Array
    time_s: Array
    length_m: float
    lap_s: float


def profile(points: Array, limits: Limits) -> Profile:
    """The fastest profile of a lap after a lap: the speed at the end is that at the start.

    Raises `LimitsError`.
    """
    bend, _ = curvature(points)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    grip = limits.grip * _G
    with np.errstate(divide="ignore"):
        most = np.minimum(limits.speed_mps, np.sqrt(grip / np.abs(bend)))
    # The slowest point has its speed whatever comes before and after.
    first = int(np.argmin(most))
    most_first, bend_first, steps_first = (
        np.roll(values, -first).tolist() for values in (most, np.abs(bend), steps)
    )
    forward = _forward(most_first, bend_first, steps_first, limits)
    speed = np.roll(_backward(forward, bend_first, steps_first, limits), first)
    if speed.min() < _SLOW_MPS:
        raise LimitsError(
            f"the motor must pull more than rolling and the air take, got {limits.power_w:g} W and "
            f"{limits.accel_mps2:g} m/s2 against {limits.rolling_n:g} N"
        )
    times = 2 * steps / (speed + np.roll(speed, -1))
    return Profile(
        at_m=np.concatenate([[0.0], np.cumsum(steps)[:-1]]),
        curvature_1pm=bend,
        speed_mps=speed,
        time_s=np.concatenate([[0.0], np.cumsum(times)[:-1]]),
        length_m=float(steps.sum()),
        lap_s=float(times.sum()),
    )


def _forward(most: list[float], bend: list[float], steps: list[float], limits: Limits) -> list[float]:
    speed = list(most)
    for i in range(len(speed) - 1):
        now = speed[i]
        pull = min(
            _left(now, bend[i], limits),
            limits.accel_mps2,
            limits.power_w / (limits.mass_kg * max(now, _SLOW_MPS)),
        )
        reached = now**2 + 2 * (pull - _resisted(now, limits)) * steps[i]
        speed[i + 1] = min(speed[i + 1], math.sqrt(max(reached, 0.0)))
    return speed


def _backward(most: list[float], bend: list[float], steps: list[float], limits: Limits) -> Array:
    speed = list(most)
    for i in range(len(speed) - 1, -1, -1):
        after = speed[(i + 1) % len(speed)]
        brake = min(_left(after, bend[(i + 1) % len(speed)], limits), limits.brake_mps2)
        speed[i] = min(speed[i], math.sqrt(after**2 + 2 * (brake + _resisted(after, limits)) * steps[i]))
    return np.array(speed)


def _left(speed: float, bend: float, limits: Limits) -> float:
    """What the curve leaves of the tyres' friction, m/s^2."""
    grip = limits.grip * _G
    return grip * math.sqrt(max(0.0, 1 - (speed**2 * bend / grip) ** 2))


def _resisted(speed: float, limits: Limits) -> float:
    """What rolling and the air take, m/s^2."""
    return (limits.rolling_n + limits.drag_n_s2_per_m2 * speed**2) / limits.mass_kg
