"""`iort ask`: a robot's question to the cloud, asked by the operator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from iort_contract.catalog.questions import QUESTIONS
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_station.cli.console import Lines, errors, tell
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples
from iort_station.errors import UsageError
from iort_station.fleet import control

commands = typer.Typer()


@commands.command("ask", epilog=examples("ask car7 calibration", "ask car7 raceline --body track.json"))
def ask(
    context: typer.Context,
    robot: Robot,
    question: Annotated[str, typer.Argument(help=f"One of {', '.join(QUESTIONS)}.")],
    body: Annotated[
        Path | None,
        typer.Option(help="A JSON file with the body of the question."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Ask the cloud what a robot may ask, and print the answer: indented, or as one line of JSON.

    It takes nothing from the robot's quota. Exit status 1 if the cloud refuses, with the reason.
    """
    asked = {} if body is None else _read(body)
    cloud = context.obj.cloud()
    with errors.status(f"waiting for {question} of {robot}"):
        answer = control.ask(cloud, robot, question, asked)
    tell(answer, Lines(json.dumps(answer, indent=2)), as_json=as_json)


def _read(file: Path) -> dict[str, Any]:
    try:
        return json_object(file.read_bytes(), str(file))
    except (ContractError, OSError) as error:
        raise UsageError(str(error)) from error
