"""What a stick drives: the limits of the motion command that car.yaml names, and the samples of who drove."""

from __future__ import annotations

import math
from typing import Any, Mapping

from iort_contract.limits import Value
from iort_contract.messages.control.commands import Command
from iort_contract.messages.control.driving import STOPPED, DriveLimits
from iort_contract.topics import ACCEPTED


def limited(message: Mapping[str, Any], limits: DriveLimits) -> tuple[Mapping[str, Any], bool]:
    """The message with speed and steering within the limits, and whether one was beyond.

    What is no finite number stays, as it does not fit the ROS type either.
    """
    beyond = False
    for path, most in ((limits.speed, limits.max_speed_mps), (limits.steering, limits.max_steering_rad)):
        value = _number_at(message, path)
        if value is not None and not -most <= value <= most:
            message, beyond = _with(message, path.split("."), max(-most, min(most, value))), True
    return message, beyond


def drive_sample(
    command: Command, outcome: str, driver: Command | None, left_s: float, limits: DriveLimits | None
) -> dict[str, Value]:
    """A sample of the stream `DRIVE_STREAM`; speed and steering are what the robot was told."""
    speed = steering = None
    if limits is not None and outcome in (ACCEPTED, STOPPED):
        # A field that the message leaves out is zero; a stop is.
        told = {} if outcome == STOPPED else command.message
        speed, steering = (_number_at(told, path) or 0.0 for path in (limits.speed, limits.steering))
    return {
        "session": command.session,
        "by": command.by,
        "seq": command.seq,
        "sent_us": command.sent_us,
        "outcome": outcome,
        "driver": driver.session if driver is not None else None,
        "driver_by": driver.by if driver is not None else None,
        "lease_left_ms": round(left_s * 1000),
        "speed": speed,
        "steering": steering,
    }


def _number_at(message: Any, path: str) -> float | None:
    for name in path.split("."):
        message = message.get(name) if isinstance(message, dict) else None
    number = type(message) in (int, float) and abs(message) != math.inf
    return message if number else None


def _with(message: Mapping[str, Any], path: list[str], value: float) -> dict[str, Any]:
    name, *below = path
    return {**message, name: _with(message[name], below, value) if below else value}
