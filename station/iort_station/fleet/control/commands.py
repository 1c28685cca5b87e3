"""Commands to a robot: one message, and the robot's answer."""

from __future__ import annotations

import getpass
import secrets
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, NamedTuple

from iort_contract.limits import ContractError
from iort_contract.messages.control.commands import MAX_BY_CHARACTERS, Command, encode_command
from iort_contract.messages.control.driving import DRIVEN_BY_ANOTHER, NO_LEASE
from iort_contract.tables import DISCONNECTED_MS, ONLINE
from iort_contract.topics import CMD, build_topic
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.fleet.control.shadow import Shadow, outcome, slept
from iort_station.times import iso_s

VALID_MS, ANSWER_S = 2_000, 10.0


# A robot of which the registry does not yet know that it is connected may still answer.
_OFFLINE_S = 2.0
_ADVICE = {
    NO_LEASE: "say by --lease-ms how long it may move, such as --lease-ms 500",
    DRIVEN_BY_ANOTHER: "wait for the end of the other lease, or take the wheel by --takeover",
}


class Sent(NamedTuple):
    """A command that was sent. ``outcome`` is `ACCEPTED`, the robot's reason, or None without an answer;
    ``offline`` says that the registry does not know it to be connected, or is empty."""

    command: Command
    outcome: str | None
    offline: str = ""


def advice(outcome: str) -> str:
    """What helps against a rejection; empty if nothing in particular does."""
    for reason, text in _ADVICE.items():
        if outcome.startswith(reason.replace("_", " ")):
            return text
    return ""


def operator() -> str:
    """Who sends commands from this computer: the user's name, as the computer knows it."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # no such user, as in a container
        name = "unknown"
    return "".join(filter(str.isprintable, name))[:MAX_BY_CHARACTERS] or "unknown"


def send(cloud: Cloud, robot: str, name: str, message: Mapping[str, Any], **given: Any) -> Sent:
    """As `sending`, which has the arguments, in one call."""
    return slept(sending(cloud, robot, name, message, **given))


def sending(
    cloud: Cloud,
    robot: str,
    name: str,
    message: Mapping[str, Any],
    *,
    lease_ms: int | None = None,
    valid_ms: int = VALID_MS,
    seconds: float = ANSWER_S,
    takeover: bool = False,
    on_offline: Callable[[str], None] = lambda _text: None,
) -> Generator[None, None, Sent]:
    """Send a command and wait for the robot's answer, at most ``seconds``: it yields between two looks.

    Every call is an operator's session of its own. While another one drives, its motion is refused, unless it
    says ``takeover``. ``lease_ms`` is how long the robot may move. A robot that is not connected is hardly
    waited for; ``on_offline`` learns it at once. Raises `UsageError` for an unknown robot and for an invalid
    command.
    """
    shadow = Shadow(cloud, robot)
    now_us = time.time_ns() // 1000
    try:
        topic = build_topic(CMD, robot, name, cloud.namespace)
        command = Command(
            session=secrets.token_hex(8),
            started_us=now_us,
            seq=0,
            sent_us=now_us,
            valid_ms=valid_ms,
            message=message,
            lease_ms=lease_ms,
            answer=True,
            by=operator(),
            takeover=takeover,
        )
        payload = encode_command(command)
    except ContractError as error:
        raise UsageError(str(error)) from error
    shadow.data.publish(topic=topic, qos=1, payload=payload)
    if offline := _offline(cloud, robot):
        on_offline(offline)
        seconds = min(seconds, _OFFLINE_S)
    said = yield from shadow.waiting(
        lambda state: outcome(state, name, command.session, command.seq), seconds
    )
    return Sent(command, said, offline if said is None else "")


def _offline(cloud: Cloud, robot: str) -> str:
    row = registry.get(cloud, robot)
    if row.get(ONLINE):
        return ""
    since_ms = row.get(DISCONNECTED_MS)
    return f"{robot} is not connected" + (f" since {iso_s(int(since_ms) * 1000)}" if since_ms else "")
