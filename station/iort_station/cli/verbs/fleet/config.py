"""`iort config`: read and change the settings of a running agent."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Annotated, Any

import typer

from iort_station.cli.console import Console
from iort_station.errors import StationError
from iort_station.fleet.shadow import Shadow, State, answered

commands = typer.Typer()
_out = Console()
_errors = Console(stderr=True)
# How long a robot that is there may take to have the file's value in force again.
_WITHDRAWN_S = 3.0


@commands.command("config")
def config(
    context: typer.Context,
    robot: str,
    changes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]...", help="live.rate_hz=5, fields.vesc=speed,fault_code, log_level=debug"
        ),
    ] = None,
    unset: Annotated[
        list[str] | None, typer.Option(help="A name to withdraw the wish of: car.yaml's value counts again.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long to wait for the robot's answer.")] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Show what is in force on a robot, or change it and wait for its answer.

    Ends with 1 where the robot refuses a change, or does not answer; the wish stands then, and comes into
    force when the robot is back. A wish that is refused stands too, until --unset withdraws it.
    """
    wishes = {**dict(map(_change, changes or [])), **dict.fromkeys(unset or [])}
    shadow = Shadow(context.obj.cloud(), robot)
    late = False
    if wishes:
        before = shadow.read()
        shadow.desire(wishes)
        with _errors.status(f"waiting for {robot}"):
            late = shadow.wait(lambda state: answered(wishes, state), seconds) is None
            old, wished = before.settings(), before.desired_settings()
            withdrawn = [n for n, value in wishes.items() if value is None and wished.get(n) == old.get(n)]
            if withdrawn and not late:
                # The file's value may be the same, which a robot does not report again.
                shadow.wait(lambda state: _all_changed(withdrawn, old, state), min(seconds, _WITHDRAWN_S))
    state = shadow.read()
    refused = [refusal for refusal in state.rejections() if not wishes or refusal.name in wishes]
    if as_json:
        refusals = {one.name: {"value": one.value, "reason": one.reason} for one in refused}
        _out.print_json(json.dumps({"settings": state.settings(), "refused": refusals, "answered": not late}))
    else:
        _show(robot, state, wishes, {refusal.name for refusal in refused})
        for refusal in refused:
            _errors.print(f"refused: {refusal.reason}", style="red")
        if refused:
            options = " ".join(f"--unset {refusal.name}" for refusal in refused)
            _errors.print(
                f"what is refused stays wished for; `iort config {robot} {options}` withdraws it",
                soft_wrap=True,
            )
    if late:
        raise StationError(
            f"{robot} has not answered within {seconds:g} s: is its agent running? "
            "The wish stands; --unset withdraws one"
        )
    if wishes and refused:
        raise typer.Exit(1)


def _all_changed(names: Sequence[str], old: Mapping[str, Any], state: State) -> bool | None:
    now = state.settings()
    return all(now.get(name) != old.get(name) for name in names) or None


def _change(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise StationError(f"{text}: expected NAME=VALUE, such as live.rate_hz=5")
    if name.startswith("fields."):
        return name, [field for field in value.split(",") if field]
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _show(robot: str, state: State, wishes: Mapping[str, Any], refused: AbstractSet[str]) -> None:
    if not state.reported:
        _out.print(f"{robot} has reported no settings yet")
    said = {
        name: "  (asked for now)" if value is not None else "  (wish withdrawn)"
        for name, value in wishes.items()
    } | dict.fromkeys(refused, "  (car.yaml's: the wish is refused)")
    for name, value in state.settings().items():
        shown = ",".join(value) if isinstance(value, list) else json.dumps(value).strip('"')
        _out.print(f"{name}={shown}{said.get(name, '')}")
