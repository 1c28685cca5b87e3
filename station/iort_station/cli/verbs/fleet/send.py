"""`iort send`: a command to a robot."""

from __future__ import annotations

import json
import secrets
import time
from typing import Annotated, Any

import typer

from iort_contract.limits import ContractError
from iort_contract.messages.commands import MAX_LEASE_MS, MAX_VALID_MS, Command, encode_command
from iort_contract.topics import ACCEPTED, CMD, build_topic
from iort_station.cli.console import Console
from iort_station.errors import StationError
from iort_station.fleet.shadow import Shadow, outcome

commands = typer.Typer()
_out = Console()
_errors = Console(stderr=True)


@commands.command("send")
def send(
    context: typer.Context,
    robot: str,
    name: Annotated[str, typer.Argument(help="The command: a key of downlink.cmd in its car.yaml.")],
    message: Annotated[str, typer.Argument(help="The ROS message as JSON, by its type's own fields.")],
    lease_ms: Annotated[
        int | None,
        typer.Option(
            min=1, max=MAX_LEASE_MS, help="What moves the robot needs one: for how long it may, from now."
        ),
    ] = None,
    valid_ms: Annotated[
        int, typer.Option(min=1, max=MAX_VALID_MS, help="Refused when it arrives later than this.")
    ] = 2_000,
    seconds: Annotated[float, typer.Option(min=0, help="How long to wait for the robot's answer.")] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Send a command and say what the robot made of it.

    Ends with 1 where the robot refuses it or says nothing. Every call is an operator's session of its
    own, which takes over from those before.
    """
    cloud = context.obj.cloud()
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
            message=_message(message),
            lease_ms=lease_ms,
            answer=True,
        )
        payload = encode_command(command)
    except ContractError as error:
        raise StationError(str(error)) from error
    shadow.data.publish(topic=topic, qos=1, payload=payload)
    with _errors.status(f"waiting for {robot}"):
        said = shadow.wait(lambda state: outcome(state, name, command.session, command.seq), seconds)
    if as_json:
        sent = {"robot": robot, "command": name, "session": command.session, "seq": command.seq}
        _out.print_json(json.dumps({**sent, "outcome": said}))
    elif said == ACCEPTED:
        _out.print(f"{robot} has accepted {name}")
    if said is None:
        raise StationError(
            f"{robot} has said nothing within {seconds:g} s: is its agent running, and has its car.yaml "
            f"downlink.cmd.{name}?"
        )
    if said != ACCEPTED:
        raise StationError(f"{robot} has refused {name}: {said}")


def _message(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except ValueError as error:
        raise StationError(f"{text}: is not JSON: {error}") from error
    if not isinstance(message, dict):
        raise StationError(f"{text}: expected a JSON object, the ROS message's fields")
    return message
