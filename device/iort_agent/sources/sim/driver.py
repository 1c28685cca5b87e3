"""The driver of a simulated car: follows the centre line, at the speed that tyres, motor and brakes allow."""

from __future__ import annotations

import math
import random
from typing import NamedTuple

from iort_agent.sources.sim.circuit import Circuit, Grip, wrapped

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
