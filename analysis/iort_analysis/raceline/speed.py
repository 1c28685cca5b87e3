"""The fastest speeds along a line, by the car's limits: a lap in a steady state at each point.

Source: Heilmeier et al. (see line.py), section 5: the speed that the curve allows, then forward what the
motor adds, then backward what the brakes take. The tyres have one friction circle for both directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iort_analysis.errors import AnalysisError
from iort_analysis.raceline.reference import curvature

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

    at_m: NDArray[np.float64]
    curvature_1pm: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    time_s: NDArray[np.float64]
    length_m: float
    lap_s: float


def profile(points: NDArray[np.float64], limits: Limits) -> Profile:
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


def _backward(
    most: list[float], bend: list[float], steps: list[float], limits: Limits
) -> NDArray[np.float64]:
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
