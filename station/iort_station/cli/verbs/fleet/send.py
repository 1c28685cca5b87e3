"""`iort send`: a command to a robot."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from iort_contract.messages.commands import MAX_LEASE_MS, MAX_VALID_MS
from iort_contract.topics import ACCEPTED
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples, say
from iort_station.errors import StationError, UsageError
from iort_station.fleet import control as fleet_commands
from iort_station.texts import one_line

commands = typer.Typer()


@commands.command("send", epilog=examples("""send car7 drive '{"drive": {"speed": 1.0}}' --lease-ms 500"""))
def send(
    context: typer.Context,
    robot: Robot,
    name: Annotated[str, typer.Argument(help="The command: a key of downlink.cmd in the robot's car.yaml.")],
    message: Annotated[str, typer.Argument(help="The ROS message as JSON, with the fields of its type.")],
    lease_ms: Annotated[
        int | None,
        typer.Option(
            min=1, max=MAX_LEASE_MS, help="How long the robot may move, from now; needed if it moves."
        ),
    ] = None,
    valid_ms: Annotated[
        int, typer.Option(min=1, max=MAX_VALID_MS, help="The robot rejects it if it arrives later than this.")
    ] = fleet_commands.VALID_MS,
    seconds: Annotated[
        float, typer.Option(min=0, help="How long to wait for the robot's answer.")
    ] = fleet_commands.ANSWER_S,
    takeover: Annotated[
        bool, typer.Option("--takeover", help="Take the wheel from whoever drives; refused otherwise.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Send a command and print the robot's answer.

    Exit status 1 if the robot rejects it or does not answer. Every call is an operator's session of its own:
    while another one drives, also an earlier call of yours, a motion is refused unless it has --takeover.
    """
    asked = _message(message)
    cloud = context.obj.cloud()
    with errors.status(f"waiting for {robot}"):
        command, said, offline = fleet_commands.send(
            cloud,
            robot,
            name,
            asked,
            lease_ms=lease_ms,
            valid_ms=valid_ms,
            seconds=seconds,
            takeover=takeover,
            on_offline=say,
        )
    if as_json:
        sent = {"robot": robot, "command": name, "session": command.session, "seq": command.seq}
        print_json({**sent, "outcome": said})
    elif said == ACCEPTED:
        out.print(f"{robot} has accepted {name}")
    if offline:
        raise StationError(f"{offline}, and has not answered")
    if said is None:
        raise StationError(
            f"{robot} has not answered within {seconds:g} s: is its agent running, and has its car.yaml "
            f"downlink.cmd.{name}?"
        )
    if said != ACCEPTED:
        advice = fleet_commands.advice(said)
        raise StationError(f"{robot} has rejected {name}: {one_line(said)}{advice and f': {advice}'}")


def _message(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except ValueError as error:
        raise UsageError(f"MESSAGE must be JSON, got {text}: {error}") from error
    if not isinstance(message, dict):
        raise UsageError(f"MESSAGE must be a JSON object with the ROS message's fields, got {text}")
    return message
