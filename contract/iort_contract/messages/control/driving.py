"""Driving a robot by hand: what the stick drives and how far, and what becomes of each command.

A driver sends `DRIVE_RATE_HZ` commands a second with a lease of `DRIVE_LEASE_MS`, less a margin. A hold of
the stick ends when the round trip or the age of the newest sample is above its limit. Then, and after the
driver has let go, the commands say to stand: the car is held, and no planner drives off, until the driver
leaves the wheel. tests/unit/station/fleet/driving.json says what each driver does, the page's and the
terminal's.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import Any, Mapping

from iort_contract.checks import FIELD_NAME, checked, shown
from iort_contract.limits import ContractError
from iort_contract.messages.control.commands import MAX_LEASE_MS
from iort_contract.topics import check_stream

DRIVE_RATE_HZ = 20.0
DRIVE_LEASE_MS = 500
# Above either, a driver sees too late what the car does. The round trip is from a command to its sample of
# the stream `drive`.
DRIVE_MAX_RTT_MS, DRIVE_MAX_AGE_MS = 500, 1_000
# A command's lease ends this much before the longest: the sender knows the cloud's clock to half a round
# trip, and the agent takes its time to stop.
DRIVE_MARGIN_MS = 50
# A car that has not answered by then does not hear the driver.
DRIVE_ANSWER_MS = 2_000
# The end of a session is sent this often: a message may be lost.
DRIVE_ENDS = 3
# A wrong clock is known after one answer, and corrected with a new session.
DRIVE_CORRECTIONS = 2
# What told the cloud's time is believed so long: clocks drift.
DRIVE_CLOCK_KEPT_MS = 60_000

# The outcomes of a motion, beside `ACCEPTED`: why it was refused.
STALE, LEASE_OVER, EARLY, REPEATED, SUPERSEDED, NO_LEASE, CLOCK_UNKNOWN, CLOSED, NO_ROS = (
    "stale",
    "lease_over",
    "from_the_future",
    "repeated_or_out_of_order",
    "from_an_earlier_session",
    "without_lease",
    "clock_offset_unknown",
    "shutting_down",
    "no_ros",
)
DRIVEN_BY_ANOTHER, EMERGENCY_STOP, BEGIN_AGAIN, SETTINGS_UNKNOWN, NO_GUARD = (
    "driven_by_another",
    "emergency_stop",
    "begin_again",
    "settings_unknown",
    "guard_not_ready",
)
# The ROS type of a car that a stick drives, as the simulated one.
DRIVE_TYPE = "ackermann_msgs/AckermannDriveStamped"
# Above `downlink` in a car.yaml that is written for a simulated car.
DOWNLINK_NOTE = """\
# What `iort drive`, `iort send` and the page move, and what the emergency stop ends: without a command with
# motion, a stop does nothing. These are the simulated car's. For a ROS 1 car, name its own topic and type
# (docs/how-to/drive.md); a car without ROS 1 cannot be moved by commands: remove the section.
"""
# Why a robot rejects a stop, and what its operators are told before they need one.
NO_MOTION = "nothing to stop: downlink.cmd has no command with motion"
# Why a robot rejects a command of any kind.
NO_COMMAND = "no_such_command"
# Not of a command: the lease ended, or an emergency stop began, and the robot was stopped.
STOPPED = "stopped"
REFUSALS: Mapping[str, str] = {
    DRIVEN_BY_ANOTHER: "another session drives; begin a new one that takes over",
    EMERGENCY_STOP: "the robot is stopped until somebody releases it",
    BEGIN_AGAIN: "this session was refused before, or a stop ended it; let go, and begin a new one",
    SUPERSEDED: "a later session has driven since",
    REPEATED: "a later command of the session has passed",
    SETTINGS_UNKNOWN: "the robot has just connected, and does not know yet whether it must stand still",
    CLOCK_UNKNOWN: "the robot does not know the cloud's time yet",
    LEASE_OVER: "the command's lease had ended when it came, or the robot was stopped after it was sent",
    STALE: "the command was too old when it came",
    EARLY: "the command's time lies in the future: the sender's clock is wrong",
    NO_LEASE: "a motion needs `lease_ms`",
    NO_GUARD: "the process that stops the robot if the agent dies is not running yet",
    NO_ROS: "the agent is not in the ROS graph",
    CLOSED: "the agent is ending",
}
# What ends a driver's session for good. After any other refusal the car is told on to stand.
LOST = (DRIVEN_BY_ANOTHER, EMERGENCY_STOP, BEGIN_AGAIN, SUPERSEDED, CLOSED)
# What a wrong clock of the driver's looks like.
UNTIMELY = (STALE, LEASE_OVER, EARLY)


def stick_downlink(lease_ms: int = DRIVE_LEASE_MS) -> dict[str, Any]:
    """The section `downlink` of the car.yaml of a simulated car: one command, which a stick drives and a stop
    ends."""
    motion = {"lease_s": lease_ms / 1000, "stop": {"drive": {"speed": 0.0}}}
    return {
        "cmd": {"drive": {"topic": "/drive", "type": DRIVE_TYPE, "partial": True, "motion": motion}},
        "drive": {"max_speed_mps": 2.0, "max_steering_rad": 0.4},
    }


@dataclass(frozen=True)
class DriveLimits:
    """The motion command that a stick drives, and the robot's own limits for it.

    ``speed`` and ``steering`` are the paths of two fields of its ROS message. The robot limits both, to
    either side, in every command of this name, and a lease to ``lease_ms``.
    """

    command: str
    speed: str
    steering: str
    max_speed_mps: float
    max_steering_rad: float
    lease_ms: int

    def message(self, speed_mps: float, steering_rad: float) -> dict[str, Any]:
        """The ROS message with these values; all its other fields are left out."""
        message: dict[str, Any] = {}
        for path, value in ((self.speed, speed_mps), (self.steering, steering_rad)):
            *above, name = path.split(".")
            inner = message
            for part in above:
                inner = inner.setdefault(part, {})
            inner[name] = value
        return message


def encode_limits(limits: DriveLimits | None) -> dict[str, Any]:
    """The limits as an object of the shadow; empty for a robot that cannot be driven by hand."""
    return asdict(limits) if limits is not None else {}


def decode_limits(document: Any) -> DriveLimits | None:
    """The limits from the shadow; None if the robot has none, or others than `check_limits` allows."""
    try:
        return check_limits(DriveLimits(**document)) if document else None
    except (ContractError, TypeError):
        return None


def check_limits(limits: DriveLimits) -> DriveLimits:
    """Return the limits, if they are valid; raises `ContractError`."""
    check_stream(limits.command)
    for what, path in (("speed", limits.speed), ("steering", limits.steering)):
        check_path(path, what)
    if f"{limits.speed}.".startswith(f"{limits.steering}.") or limits.steering.startswith(f"{limits.speed}."):
        raise ContractError(f"speed and steering must be two fields, got {limits.speed}, {limits.steering}")
    for name, value in (
        ("max_speed_mps", limits.max_speed_mps),
        ("max_steering_rad", limits.max_steering_rad),
    ):
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        # An integer may be larger than every float.
        if not number or not 0 < value <= sys.float_info.max:
            raise ContractError(f"{name} must be a number above 0, got {shown(value)}")
    if type(limits.lease_ms) is not int or not 1 <= limits.lease_ms <= MAX_LEASE_MS:
        raise ContractError(
            f"lease_ms must be an integer from 1 to {MAX_LEASE_MS}, got {shown(limits.lease_ms)}"
        )
    return limits


def check_path(path: str, what: str) -> str:
    """Return ``path`` if it is a field of a message, or of messages within it; not an array's element."""
    checked(FIELD_NAME, path, what, "a ROS field name or a dotted path of them")
    # A page makes an object of the path, where `__proto__` is no name.
    if any(part.isdigit() or part.startswith("_") for part in path.split(".")):
        raise ContractError(f"{what} must not be an array's element, nor begin with _, got {shown(path)}")
    return path
