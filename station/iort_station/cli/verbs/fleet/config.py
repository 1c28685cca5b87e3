"""`iort config`: read and change the settings of a running agent."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any

import typer

from iort_contract.limits import ContractError
from iort_contract.messages.settings import FIELDS, check_setting
from iort_contract.messages.shadow import Rejection
from iort_contract.tables import ONLINE
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.fleet.shadow import Shadow, State, answered

commands = typer.Typer()
# How long a robot may take to return to the file's value.
_WITHDRAWN_S = 3.0
# A robot that the registry does not yet know to be connected may still answer.
_OFFLINE_S = 2.0


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
    shadow = Shadow(cloud, robot)
    if not wanted:
        state = shadow.read()
        rejected = state.reported.rejected
        _print(robot, state, rejected, {}, as_json=as_json)
        if rejected and not as_json:
            options = " ".join(f"--unset {name}" for name in rejected)
            errors.print(f"`iort config {robot} {options}` withdraws what is rejected", soft_wrap=True)
        return
    online = bool(registry.get(cloud, robot).get(ONLINE))
    before = shadow.read()
    answer = _change_and_wait(shadow, before, wanted, seconds if online else min(seconds, _OFFLINE_S))
    state = shadow.read()
    rejected = {name: one for name, one in state.reported.rejected.items() if name in wanted}
    _withdraw(shadow, before, state, {name: wanted[name] for name in rejected})
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
    value: Any = written
    if name.startswith(f"{FIELDS}."):
        value = [field for field in written.split(",") if field]
    else:
        with suppress(ValueError):  # a text
            value = json.loads(written)
    try:
        check_setting(name, value)
    except ContractError as error:
        raise UsageError(f"{error}; nothing is changed") from error
    return name, value


def _change_and_wait(shadow: Shadow, before: State, wanted: Mapping[str, Any], seconds: float) -> bool:
    """Request the changes; whether the robot has answered in time."""
    shadow.desire(wanted)
    with errors.status(f"waiting for {shadow.robot}"):
        if shadow.wait(lambda state: answered(wanted, state), seconds) is None:
            return False
        old, requested = before.reported.settings, before.desired.settings
        withdrawn = [n for n, value in wanted.items() if value is None and requested.get(n) == old.get(n)]
        if withdrawn:
            # The file may hold the same value, which the robot does not report again.
            shadow.wait(
                lambda state: all(state.reported.settings.get(n) != old.get(n) for n in withdrawn) or None,
                min(seconds, _WITHDRAWN_S),
            )
    return True


def _withdraw(shadow: Shadow, before: State, state: State, rejected: Mapping[str, Any]) -> None:
    """Replace rejected changes by the desired values before them, unless somebody has changed them since."""
    old, now = before.desired.settings, state.desired.settings
    known = before.reported.rejected
    again = {
        name: None if name in known else old.get(name)
        for name, value in rejected.items()
        if now.get(name) == value
    }
    if again:
        shadow.desire(again)


def _print(
    robot: str,
    state: State,
    rejected: Mapping[str, Rejection],
    wanted: Mapping[str, Any],
    *,
    as_json: bool,
) -> None:
    settings, pending = state.reported.settings, state.pending()
    if as_json:
        reasons = {name: one._asdict() for name, one in rejected.items()}
        print_json({"robot": robot, "settings": settings, "rejected": reasons, "pending": pending})
        return
    if not settings:
        out.print(f"{robot} has reported no settings yet")
    said = {name: "  (withdrawn)" if value is None else "  (changed)" for name, value in wanted.items()}
    said |= dict.fromkeys(rejected, "  (unchanged: the change is rejected)")
    said |= {name: f"  (pending: {_shown(value)})" for name, value in pending.items()}
    for name, value in {**dict.fromkeys(pending, "?"), **settings}.items():
        out.print(f"{name}={_shown(value)}{said.get(name, '')}")
    for one in rejected.values():
        errors.print(f"rejected: {one.reason}", style="red")


def _shown(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list) else json.dumps(value).strip('"')
