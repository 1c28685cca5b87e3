"""Commands to a robot: one message, and the robot's answer."""

from __future__ import annotations

import getpass
import secrets
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from iort_contract.limits import ContractError
from iort_contract.messages.control.commands import MAX_BY_CHARACTERS, Command, encode_command
from iort_contract.topics import CMD, build_topic
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet.control.shadow import Shadow, outcome

VALID_MS, ANSWER_S = 2_000, 10.0


class Sent(NamedTuple):
    """A command that was sent. ``outcome`` is `ACCEPTED`, the robot's reason, or None without an answer."""

    command: Command
    outcome: str | None


def operator() -> str:
    """Who sends commands from this computer: the user's name, as the computer knows it."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # no such user, as in a container
        name = "unknown"
    return "".join(filter(str.isprintable, name))[:MAX_BY_CHARACTERS] or "unknown"


def send(
    cloud: Cloud,
    robot: str,
    name: str,
    message: Mapping[str, Any],
    *,
    lease_ms: int | None = None,
    valid_ms: int = VALID_MS,
    seconds: float = ANSWER_S,
) -> Sent:
    """Send a command and wait for the robot's answer, at most ``seconds``.

    Every call is an operator's session of its own, which takes over from the one that drives. ``lease_ms`` is
    how long the robot may move. Raises `UsageError` for an unknown robot and for an invalid command.
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
            takeover=True,
        )
        payload = encode_command(command)
    except ContractError as error:
        raise UsageError(str(error)) from error
    shadow.data.publish(topic=topic, qos=1, payload=payload)
    return Sent(
        command, shadow.wait(lambda state: outcome(state, name, command.session, command.seq), seconds)
    )
