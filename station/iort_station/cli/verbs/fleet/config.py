"""`iort config`: read and change the settings of a running agent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from iort_contract.messages.shadow import Rejection
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples
from iort_station.errors import StationError, UsageError
from iort_station.fleet import control
from iort_station.fleet.control import Shadow, State

commands = typer.Typer()


@commands.command(
    "config", epilog=examples("config car7", "config car7 live.rate_hz=5 fields.vesc=speed,fault_code")
)
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

    A value that no agent accepts is not sent. A change that the robot rejects is withdrawn: the last accepted
    value stays in force, and the exit status is 1. A change for an offline robot is pending until it is back.
    """
    wanted = {**dict(map(_change, changes or [])), **dict.fromkeys(unset or [])}
    cloud = context.obj.cloud()
    if not wanted:
        state = Shadow(cloud, robot).read()
        rejected = state.rejected()
        _print(robot, state, rejected, {}, as_json=as_json)
        if rejected and not as_json:
            options = " ".join(f"--unset {name}" for name in rejected)
            errors.print(f"`iort config {robot} {options}` withdraws what is rejected", soft_wrap=True)
        return
    with errors.status(f"waiting for {robot}"):
        state, rejected, online, answer = control.change_settings(cloud, robot, wanted, seconds)
    _print(robot, state, rejected, wanted, as_json=as_json)
    pending = state.pending().keys() & wanted.keys()
    if not answer and online:
        raise StationError(
            f"{robot} is online and has not answered within {seconds:g} s: is its agent running? "
            "The change is pending; --unset withdraws it"
        )
    if pending and not as_json:
        errors.print(f"pending: {robot} is offline, and applies it when it is back", soft_wrap=True)
    if rejected:
        raise typer.Exit(1)


def _change(text: str) -> tuple[str, Any]:
    name, equals, written = text.partition("=")
    if not name or not equals:
        raise UsageError(f"must be NAME=VALUE, for example live.rate_hz=5, got {text}")
    return name, control.parse_setting(name, written)


def _print(
    robot: str,
    state: State,
    rejected: Mapping[str, Rejection],
    wanted: Mapping[str, Any],
    *,
    as_json: bool,
) -> None:
    in_force, pending = state.reported.settings, state.pending()
    if as_json:
        reasons = {name: one._asdict() for name, one in rejected.items()}
        print_json({"robot": robot, "settings": in_force, "rejected": reasons, "pending": pending})
        return
    if not in_force:
        out.print(f"{robot} has reported no settings yet")
    said = {name: "  (withdrawn)" if value is None else "  (changed)" for name, value in wanted.items()}
    said |= dict.fromkeys(rejected, "  (unchanged: the change is rejected)")
    said |= {name: f"  (pending: {control.setting_text(value)})" for name, value in pending.items()}
    for name, value in {**dict.fromkeys(pending, "?"), **in_force}.items():
        out.print(f"{name}={control.setting_text(value)}{said.get(name, '')}")
    for one in rejected.values():
        errors.print(f"rejected: {one.reason}", style="red")
