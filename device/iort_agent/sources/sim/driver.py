"""The track of a simulated car, and its driver, who follows the centre line at the speed that tyres, motor
and brakes allow."""

from __future__ import annotations

import math
import random
from typing import NamedTuple, Sequence

from iort_contract.track import Track

_STEP_M = 0.1
_MAX_STEPS = 10_000
# Curvature is measured over this distance to either side, which smooths the corners of a coarse line.
_SMOOTHED_M = 0.3


class Grip(NamedTuple):
    """What limits the speed on a track: motor, tyres in a corner, motor again, and brakes."""

    top_mps: float
    lateral_mps2: float
    accelerate_mps2: float
    brake_mps2: float


class Circuit:
    """The centre line of a track at steps of ``step_m``: place i is ``i * step_m`` after the start."""

    def __init__(self, track: Track) -> None:
        lengths = _lengths(track)
        self.length_m = sum(lengths)
        self.steps = min(_MAX_STEPS, max(16, round(self.length_m / _STEP_M)))
        self.step_m = self.length_m / self.steps
        self.x_m = _resampled(track.x_m, lengths, self.steps)
        self.y_m = _resampled(track.y_m, lengths, self.steps)
        self.narrowest_m = min(*track.w_right_m, *track.w_left_m)
        self.heading_rad = [
            math.atan2(
                self.y_m[(i + 1) % self.steps] - self.y_m[i - 1],
                self.x_m[(i + 1) % self.steps] - self.x_m[i - 1],
            )
            for i in range(self.steps)
        ]
        around = max(1, round(_SMOOTHED_M / self.step_m))
        self.curvature_per_m = [
            wrapped(self.heading_rad[(i + around) % self.steps] - self.heading_rad[i - around])
            / (2 * around * self.step_m)
            for i in range(self.steps)
        ]

    def nearest(self, x_m: float, y_m: float, place: int | None = None) -> int:
        """The place nearest to a point; with ``place``, the nearest on the way from there, found faster."""
        if place is None:
            return min(range(self.steps), key=lambda i: self._distance2(i, x_m, y_m))
        for way in (1, -1):
            while self._distance2(place + way, x_m, y_m) < self._distance2(place, x_m, y_m):
                place = (place + way) % self.steps
        return place

    def beside(self, place: int, left_m: float) -> tuple[float, float]:
        """The point so far to the left of a place."""
        heading = self.heading_rad[place % self.steps]
        return (
            self.x_m[place % self.steps] - left_m * math.sin(heading),
            self.y_m[place % self.steps] + left_m * math.cos(heading),
        )

    def speeds_mps(self, grip: Grip) -> list[float]:
        """The highest speed at each place, so that tyres and motor can follow.

        Tyres hold a corner at ``sqrt(lateral / curvature)``; what they need for it is missing for the
        acceleration and for the brakes (the circle of friction).
        """
        lateral = grip.lateral_mps2
        top = [
            min(grip.top_mps, math.sqrt(lateral / max(abs(curvature), 1e-9)))
            for curvature in self.curvature_per_m
        ]
        # Twice around, since the line is closed: backwards for the brakes, forwards for the motor.
        for way, limit in ((-1, grip.brake_mps2), (1, grip.accelerate_mps2)):
            for i in range(2 * self.steps)[::way]:
                here, there = i % self.steps, (i + way) % self.steps
                used = top[here] ** 2 * abs(self.curvature_per_m[here]) / lateral
                left = limit * math.sqrt(max(0.0, 1 - used**2))
                top[there] = min(top[there], math.sqrt(top[here] ** 2 + 2 * left * self.step_m))
        return top

    def _distance2(self, place: int, x_m: float, y_m: float) -> float:
        i = place % self.steps
        return (self.x_m[i] - x_m) ** 2 + (self.y_m[i] - y_m) ** 2


def wrapped(angle: float) -> float:
    """The angle from -pi to pi."""
    return math.remainder(angle, 2 * math.pi)


def rounded(corners: Sequence[tuple[float, float, float]], width_m: float) -> Track:
    """The track along straight lines between corners, each rounded: x, y and radius of its arc, in metres."""
    points: list[tuple[float, float]] = []
    for i, (x, y, radius) in enumerate(corners):
        (x0, y0, _), (x1, y1, _) = corners[i - 1], corners[(i + 1) % len(corners)]
        into, out = math.atan2(y - y0, x - x0), math.atan2(y1 - y, x1 - x)
        turn = wrapped(out - into)
        # The arc begins so far before the corner, and its centre is at a right angle to the way in.
        before = radius * math.tan(abs(turn) / 2)
        side = math.copysign(math.pi / 2, turn)
        from_x, from_y = x - before * math.cos(into), y - before * math.sin(into)
        centre_x, centre_y = from_x + radius * math.cos(into + side), from_y + radius * math.sin(into + side)
        pieces = math.ceil(radius * abs(turn) / _STEP_M)
        for piece in range(pieces + 1):
            at = into - side + turn * piece / max(1, pieces)
            points.append((centre_x + radius * math.cos(at), centre_y + radius * math.sin(at)))
    x_m, y_m = zip(*points)
    widths = (width_m / 2,) * len(points)
    return Track(x_m, y_m, widths, widths)


def _lengths(track: Track) -> list[float]:
    """The distance from each point to the next."""
    n = len(track.x_m)
    return [
        math.hypot(track.x_m[(i + 1) % n] - track.x_m[i], track.y_m[(i + 1) % n] - track.y_m[i])
        for i in range(n)
    ]


def _resampled(values: Sequence[float], lengths: Sequence[float], steps: int) -> list[float]:
    """The values at even steps along the line."""
    found, i, passed, step = [], 0, 0.0, sum(lengths) / steps
    for k in range(steps):
        while i < len(lengths) - 1 and passed + lengths[i] < k * step:
            passed += lengths[i]
            i += 1
        share = (k * step - passed) / lengths[i] if lengths[i] else 0.0
        found.append(values[i] + (values[(i + 1) % len(values)] - values[i]) * share)
    return found


# 48 m in a hall of 21 m by 11 m, 2.2 m wide as the tracks of F1TENTH's simulator. It begins on the long
# straight. The tightest corner has a radius of 1.2 m; a car's tightest turn has 0.75 m.
HALL = rounded(
    [
        (3.0, 0.0, 0.0),
        (18.0, 0.0, 2.2),
        (18.0, 5.0, 1.2),
        (12.0, 3.4, 1.3),
        (9.0, 8.0, 1.6),
        (0.0, 8.0, 2.5),
        (0.0, 0.0, 1.5),
    ],
    width_m=2.2,
)


# The driver steers towards the point that is this far ahead, and further by this time at speed.
_LOOKAHEAD_M, _LOOKAHEAD_S = 0.6, 0.25
# The motor answers late, so the driver brakes early.
_REACTION_S = 0.35
# The driver changes the line in this time.
_DRIFT_S = 1.5


class Pose(NamedTuple):
    """Where a car is: the middle of its rear axle, and its direction from the x axis."""

    x_m: float
    y_m: float
    heading_rad: float


class Wish(NamedTuple):
    """What a car is to do: a speed, negative in reverse, and the front wheels' angle, left is positive."""

    speed_mps: float
    steering_rad: float


class Driver:
    """Drives laps, each a little off the centre line and a little below ``pace``, a share of the limit."""

    def __init__(
        self, circuit: Circuit, grip: Grip, wheelbase_m: float, chance: random.Random, *, pace: float = 1.0
    ) -> None:
        self._circuit, self._wheelbase_m, self._chance = circuit, wheelbase_m, chance
        self._lateral_mps2 = grip.lateral_mps2
        self._speeds_mps = circuit.speeds_mps(grip)
        self._place: int | None = 0
        self._left_m = self._goal_left_m = 0.0
        self._most_pace = self._pace = pace

    def start(self) -> Pose:
        """The beginning of a lap."""
        circuit = self._circuit
        return Pose(circuit.x_m[0], circuit.y_m[0], circuit.heading_rad[0])

    def leave(self) -> None:
        """Somebody else drives, who may leave the track: look for it again afterwards."""
        self._place = None

    def wish(self, pose: Pose, speed_mps: float, dt: float) -> Wish:
        """The speed and the steering now."""
        circuit = self._circuit
        before, here = self._place, circuit.nearest(pose.x_m, pose.y_m, self._place)
        if before is not None and before - here > circuit.steps // 2:
            self._begin_lap()
        self._place = here
        self._left_m += (self._goal_left_m - self._left_m) * min(1.0, dt / _DRIFT_S)
        steering = self._steering(pose, here, speed_mps)
        ahead = here + round(max(0.0, speed_mps) * _REACTION_S / circuit.step_m)
        target = min(self._speeds_mps[here], self._speeds_mps[ahead % circuit.steps]) * self._pace
        # On the way back to the track the car turns more sharply than the line does.
        turns_per_m = abs(math.tan(steering)) / self._wheelbase_m
        return Wish(min(target, math.sqrt(self._lateral_mps2 / max(turns_per_m, 1e-9))), steering)

    def _begin_lap(self) -> None:
        self._pace = self._most_pace * self._chance.uniform(0.93, 1.0)
        self._goal_left_m = self._chance.uniform(-0.25, 0.25) * self._circuit.narrowest_m

    def _steering(self, pose: Pose, here: int, speed_mps: float) -> float:
        """Pure pursuit: the arc that leads through a point of the line ahead."""
        ahead_m = _LOOKAHEAD_M + _LOOKAHEAD_S * abs(speed_mps)
        x_m, y_m = self._circuit.beside(here + round(ahead_m / self._circuit.step_m), self._left_m)
        away_m = math.hypot(x_m - pose.x_m, y_m - pose.y_m)
        off = wrapped(math.atan2(y_m - pose.y_m, x_m - pose.x_m) - pose.heading_rad)
        if abs(off) > math.pi / 2:
            return math.copysign(math.pi / 2 - 0.01, off)
        return math.atan2(2 * self._wheelbase_m * math.sin(off), max(away_m, 1e-6))
