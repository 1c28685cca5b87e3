"""Commands to a robot, messages between robots, and driving by hand: limits, leases and who drives."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import Any, Mapping

from iort_contract.checks import (
    FIELD_NAME,
    check_header,
    check_id,
    check_time,
    checked,
    offset_entry,
    shown,
    whole_number,
)
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import codec
from iort_contract.topics import check_stream

# Upper limits, whatever an operator asks for: a command expires, and a motion must end.
MAX_VALID_MS, MAX_LEASE_MS = 60_000, 10_000
MAX_BY_CHARACTERS = 64
# The numbers of pictures have 32 bits.
MAX_FRAME = 2**32 - 1
# Other robots act on fleet messages, so they expire sooner than live samples for people (LIVE_MAX_AGE_MS).
FLEET_MAX_AGE_MS = 2_000


@dataclass(frozen=True)
class Command:
    """A ROS message for a robot to publish.

    Commands are ordered by ``started_us``, ``session``, ``seq``. ``session`` names an operator's session,
    which began at ``started_us``; ``seq`` numbers its commands, and ``by`` is who sends them. The command is
    stale ``valid_ms`` after ``sent_us``, by the cloud's clock. ``lease_ms`` limits a motion, also from
    ``sent_us``; a motion without it is refused. While the lease of one session holds, motions of another are
    refused, unless it is later and says ``takeover``. A session that was refused so stays refused. A motion
    that ``ends`` its lease stops the robot at once, and lets others drive. ``frame`` is the number of the
    newest picture on the driver's screen. A robot with video refuses a motion that names none, or an old
    one, unless its driver says that he drives ``blind``; one that ``ends`` needs neither, and is its stop.
    ``message`` is the ROS message. With ``answer`` the robot reports the result in its shadow: `COMMANDS`,
    name, ``session``, ``seq`` and ``outcome``, which is `ACCEPTED` or the reason."""

    session: str
    started_us: int
    seq: int
    sent_us: int
    valid_ms: int
    message: Mapping[str, Any]
    lease_ms: int | None = None
    answer: bool = False
    by: str | None = None
    takeover: bool = False
    ends: bool = False
    frame: int | None = None
    blind: bool = False

    @property
    def order(self) -> tuple[int, str, int]:
        return (self.started_us, self.session, self.seq)


@dataclass(frozen=True)
class FleetMessage:
    """A robot's ROS message for other robots: the newest only, ``seq`` growing within a ``boot``.
    ``offset_us`` converts ``sent_us`` to the cloud's time by addition, if the robot knows it."""

    boot: str
    seq: int
    sent_us: int
    message: Mapping[str, Any]
    offset_us: int | None = None


def _check_fleet(fleet: FleetMessage) -> None:
    check_header(fleet.boot, fleet.seq, 0)
    check_time(fleet.sent_us, "sent_us")
    offset_entry(fleet.offset_us)


encode_fleet, decode_fleet = codec(FleetMessage, "fleet message", _check_fleet)


def check_by(by: Any) -> str:
    """Return ``by`` if it is a valid name of an operator; raises `ContractError`."""
    if not isinstance(by, str) or not 1 <= len(by) <= MAX_BY_CHARACTERS or not by.isprintable():
        raise ContractError(f"by must be 1 to {MAX_BY_CHARACTERS} printable characters, got {shown(by)}")
    return by


def _check_command(command: Command) -> None:
    check_id(command.session, "session")
    check_header(command.session, command.seq, 0)
    if command.by is not None:
        check_by(command.by)
    if check_time(command.started_us, "started_us") > check_time(command.sent_us, "sent_us"):
        raise ContractError("the command was sent before its session started")
    whole_number("valid_ms", command.valid_ms, 1, MAX_VALID_MS)
    if command.lease_ms is not None:
        whole_number("lease_ms", command.lease_ms, 1, MAX_LEASE_MS)
    if command.frame is not None:
        whole_number("frame", command.frame, 1, MAX_FRAME)


encode_command, decode_command = codec(Command, "command", _check_command)


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
# Of a robot with video: the command names no picture, or one that is older than the robot allows.
NO_PICTURE, PICTURE_LATE = "no_picture", "picture_late"
# The type of a car that a stick drives, as the simulated one, in ROS 1 and in ROS 2.
DRIVE_TYPE = "ackermann_msgs/AckermannDriveStamped"
ROS2_DRIVE_TYPE = "ackermann_msgs/msg/AckermannDriveStamped"
# Above `downlink` in a car.yaml that is written for a simulated car.
DOWNLINK_NOTE = """\
# What `iort drive`, `iort send` and the page move, and what the emergency stop ends: without a command with
# motion, a stop does nothing. These are the simulated car's. For a car with ROS, name its own topic and type
# (docs/how-to/drive.md); a car without ROS cannot be moved by commands: remove the section.
"""
VIDEO_NOTE = """\
# Its camera, to drive it by sight (docs/how-to/drive.md), where `pip install 'iort-agent[video]'` was done.
# video: {source: {type: sim}}
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
    NO_PICTURE: "the command names no picture: drive on the page by its picture, or say that you drive blind",
    PICTURE_LATE: "the driver's picture was too old when the command came",
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
    whole_number("lease_ms", limits.lease_ms, 1, MAX_LEASE_MS)
    return limits


def check_path(path: str, what: str) -> str:
    """Return ``path`` if it is a field of a message, or of messages within it; not an array's element."""
    checked(FIELD_NAME, path, what, "a ROS field name or a dotted path of them")
    # A page makes an object of the path, where `__proto__` is no name.
    if any(part.isdigit() or part.startswith("_") for part in path.split(".")):
        raise ContractError(f"{what} must not be an array's element, nor begin with _, got {shown(path)}")
    return path
