"""Commands to a robot, and messages between robots."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Mapping

from iort_contract.checks import (
    BOOT,
    check_header,
    check_time,
    check_version,
    checked,
    json_object,
    offset_entry,
    shown,
)
from iort_contract.limits import MAX_MESSAGE_BYTES, SCHEMA_VERSION, ContractError
from iort_contract.messages.envelope import entries, read

# Upper limits, whatever an operator asks for: a command expires, and a motion must end.
MAX_VALID_MS, MAX_LEASE_MS = 60_000, 10_000
MAX_BY_CHARACTERS = 64
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
    that ``ends`` its lease stops the robot at once, and lets others drive.
    ``message`` is the ROS message. With ``answer`` the robot reports the result in its shadow: `COMMANDS`,
    name, ``session``, ``seq`` and ``outcome``, which is `ACCEPTED` or the reason.
    """

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

    @property
    def order(self) -> tuple[int, str, int]:
        return (self.started_us, self.session, self.seq)


def encode_command(command: Command) -> bytes:
    """The command as JSON; raises `ContractError` if it is invalid."""
    _check_command(command)
    return _message_json({"v": SCHEMA_VERSION, **entries(command)})


def decode_command(payload: bytes | str) -> Command:
    """Decode a command; raises `ContractError` for everything that `encode_command` cannot have written."""
    command = read(Command, _message_envelope(payload, "command"))
    _check_command(command)
    return command


@dataclass(frozen=True)
class FleetMessage:
    """A robot's ROS message for other robots: the newest only, ``seq`` growing within a ``boot``.
    ``offset_us`` converts ``sent_us`` to the cloud's time by addition, if the robot knows it."""

    boot: str
    seq: int
    sent_us: int
    message: Mapping[str, Any]
    offset_us: int | None = None


def encode_fleet(fleet: FleetMessage) -> bytes:
    """The message as JSON; raises `ContractError` if it is invalid."""
    _check_fleet(fleet)
    return _message_json({"v": SCHEMA_VERSION, **entries(fleet)})


def decode_fleet(payload: bytes | str) -> FleetMessage:
    """Decode another robot's message; raises `ContractError` for everything that `encode_fleet` cannot
    write."""
    fleet = read(FleetMessage, _message_envelope(payload, "fleet message"))
    _check_fleet(fleet)
    return fleet


def _check_fleet(fleet: FleetMessage) -> None:
    check_header(fleet.boot, fleet.seq, 0)
    check_time(fleet.sent_us, "sent_us")
    offset_entry(fleet.offset_us)


def check_by(by: Any) -> str:
    """Return ``by`` if it is a valid name of an operator; raises `ContractError`."""
    if not isinstance(by, str) or not 1 <= len(by) <= MAX_BY_CHARACTERS or not by.isprintable():
        raise ContractError(f"by must be 1 to {MAX_BY_CHARACTERS} printable characters, got {shown(by)}")
    return by


def _check_command(command: Command) -> None:
    checked(BOOT, command.session, "session", "8 to 32 of 0-9 a-f")
    check_header(command.session, command.seq, 0)
    for name, flag in (("answer", command.answer), ("takeover", command.takeover), ("ends", command.ends)):
        if not isinstance(flag, bool):
            raise ContractError(f"{name} must be true or false, got {shown(flag)}")
    if command.by is not None:
        check_by(command.by)
    if check_time(command.started_us, "started_us") > check_time(command.sent_us, "sent_us"):
        raise ContractError("the command was sent before its session started")
    for name, value, most in (
        ("valid_ms", command.valid_ms, MAX_VALID_MS),
        ("lease_ms", command.lease_ms, MAX_LEASE_MS),
    ):
        if value is None and name == "lease_ms":
            continue
        if type(value) is not int or not 1 <= value <= most:
            raise ContractError(f"{name} must be an integer from 1 to {most}, got {shown(value)}")


def _message_json(envelope: Mapping[str, Any]) -> bytes:
    if not isinstance(envelope["message"], dict):
        raise ContractError(f"message must be an object, got {shown(envelope['message'])}")
    try:
        payload = json.dumps(envelope, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ContractError(f"the message is not JSON: {error}") from error
    if len(payload) > MAX_MESSAGE_BYTES:
        raise ContractError(f"message must be at most {MAX_MESSAGE_BYTES} bytes, got {len(payload)}")
    return payload


def _message_envelope(payload: bytes | str, what: str) -> dict[str, Any]:
    envelope = json_object(payload, what)
    check_version(envelope)
    if not isinstance(envelope.get("message"), dict):
        raise ContractError(f"message must be an object, got {shown(envelope.get('message'))}")
    return envelope
