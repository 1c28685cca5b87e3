"""`iort config`: read and change the settings of a running agent."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.errors import StationError, UsageError
from iort_station.fleet.shadow import Shadow, State, answered

commands = typer.Typer()
# How long a robot may take to return to the file's value.
_WITHDRAWN_S = 3.0


@commands.command("config")
def config(
    context: typer.Context,
    robot: Robot,
    changes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]...", help="live.rate_hz=5, fields.vesc=speed,fault_code, log_level=debug"
        ),
    ] = None,
    unset: Annotated[
        list[str] | None, typer.Option(help="A setting to withdraw; car.yaml's value applies again.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long to wait for the robot's answer.")] = 30.0,
    as_json: AsJson = False,
) -> None:
    """Show a robot's settings, or change them and wait for its answer.

    Exit status 1 if the robot rejects a change or does not answer. A change without an answer stays
    requested: the robot applies it when it is back. --unset withdraws a change, also a rejected one.
    """
    wanted = {**dict(map(_change, changes or [])), **dict.fromkeys(unset or [])}
    shadow = Shadow(context.obj.cloud(), robot)
    answer = not wanted or _change_and_wait(shadow, wanted, seconds)
    state = shadow.read()
    rejected = [one for one in state.rejections() if not wanted or one.name in wanted]
    if as_json:
        reasons = {one.name: {"value": one.value, "reason": one.reason} for one in rejected}
        print_json({"settings": state.settings(), "refused": reasons, "answered": answer})
    else:
        _show(robot, state, wanted)
        for one in rejected:
            errors.print(f"rejected: {one.reason}", style="red")
        if rejected:
            options = " ".join(f"--unset {one.name}" for one in rejected)
            text = f"a rejected change stays requested; `iort config {robot} {options}` withdraws it"
            errors.print(text, soft_wrap=True)
    if not answer:
        raise StationError(
            f"{robot} has not answered within {seconds:g} s: is its agent running? "
            "The change stays requested; --unset withdraws it"
        )
    if wanted and rejected:
        raise typer.Exit(1)


def _change_and_wait(shadow: Shadow, wanted: Mapping[str, Any], seconds: float) -> bool:
    """Request the changes; whether the robot has answered in time."""
    before = shadow.read()
    shadow.desire(wanted)
    with errors.status(f"waiting for {shadow.robot}"):
        if shadow.wait(lambda state: answered(wanted, state), seconds) is None:
            return False
        old, requested = before.settings(), before.desired_settings()
        withdrawn = [n for n, value in wanted.items() if value is None and requested.get(n) == old.get(n)]
        if withdrawn:
            # The file may hold the same value, which the robot does not report again.
            shadow.wait(
                lambda state: all(state.settings().get(n) != old.get(n) for n in withdrawn) or None,
                min(seconds, _WITHDRAWN_S),
            )
    return True


def _change(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise UsageError(f"must be NAME=VALUE, for example live.rate_hz=5, got {text}")
    if name.startswith("fields."):
        return name, [field for field in value.split(",") if field]
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _show(robot: str, state: State, wanted: Mapping[str, Any]) -> None:
    if not state.reported:
        out.print(f"{robot} has reported no settings yet")
    said = {name: "  (withdrawn)" if value is None else "  (requested now)" for name, value in wanted.items()}
    said |= {one.name: "  (car.yaml's: the change is rejected)" for one in state.rejections()}
    for name, value in state.settings().items():
        shown = ",".join(value) if isinstance(value, list) else json.dumps(value).strip('"')
        out.print(f"{name}={shown}{said.get(name, '')}")
