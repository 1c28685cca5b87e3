"""`iort robots`: the registered robots."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.table import Table

from iort_contract.catalog.car import KNOWN
from iort_contract.messages.commands import NO_MOTION
from iort_contract.tables import (
    ADMISSION,
    ADMIT_CLAIM,
    ADMIT_FINGERPRINT,
    ADMIT_UNTIL_S,
    ADMITTED_CERTIFICATE,
    ADMITTED_MS,
    AGENT_VERSION,
    ALERT_PREFIX,
    ASKED_PREFIX,
    CONNECTED_MS,
    DAYS,
    DISCONNECT_REASON,
    DISCONNECTED_MS,
    GAIN_SET_MS,
    LAST_SEEN_MS,
    ONLINE,
    OVER_SHARE,
    PRESENCE,
    ROBOT,
    SESSION_VERSION,
    STREAMS,
)
from iort_station.cli import completion
from iort_station.cli.console import Console, errors, out, print_json, tell
from iort_station.cli.options import AsJson, From, Last, Robot, When, Yes, agreed
from iort_station.cli.progress import reading
from iort_station.cli.verbs.fleet import provisioning, tags
from iort_station.cli.words import examples, say
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet import control, identity, registry, robots, stopping
from iort_station.times import iso_s, stamped, time_us

commands = typer.Typer(name="robots", no_args_is_help=True, help="The robots that may connect.")
commands.add_typer(provisioning.commands)
commands.add_typer(tags.commands)
# What the cloud's functions keep in the row for themselves.
_INTERNAL = {SESSION_VERSION, ADMIT_CLAIM, ADMIT_FINGERPRINT}
# A pipe has no width at which a line must end.
_PIPE_WIDTH = 10_000
# Whether an emergency stop ends its motion; None before the robot has said so.
_STOPPABLE = {True: "yes", False: "NO", None: "?"}


@commands.command(
    "set",
    epilog=examples(
        "robots set car7 speed_to_erpm_gain=4614 --last 7d",
        "robots set car7 capacity_ah=5 cells=3 mass_kg=3.7 pole_pairs=2",
    ),
)
def set_(
    context: typer.Context,
    name: Robot,
    parameters: Annotated[
        list[str], typer.Argument(metavar="PARAMETER=VALUE", help=f"{', '.join([*robots.F1TENTH, *KNOWN])}.")
    ],
    start: From = None,
    last: Last = None,
    also: Annotated[
        list[str] | None,
        typer.Option(
            "--stream", help="Another stream with a speed field, unknown by its name; may be repeated."
        ),
    ] = None,
    wait: Annotated[
        bool, typer.Option(help="Wait a minute first. --no-wait is for a robot that was silent for a minute.")
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Correct a robot's vehicle parameters, and recompute the speed in its summaries.

    Queries of samples use the new parameters at once, for all times. Summaries before --from stay as
    they are. A second run changes nothing; after an interruption it does the rest.

    Mass, pole pairs, cells and capacity are for the analysis: of drives that are analysed from now on, it
    also tells torque, inertia, the battery's charge and the range that is left. No summary depends on them.
    """
    vehicle = robots.checked_vehicle(dict(_parameter(text) for text in parameters))
    from_us = When(start, last=last).range().start_us
    cloud = context.obj.cloud()
    before = registry.set_vehicle(cloud, name, registry.given(vehicle))
    for key, value in vehicle.items():
        was = f"{before[key]:.12g}" if key in before else "not set"
        facts = {"robot": name, "parameter": key, "value": value, "was": before.get(key)}
        tell(facts, f"{name}: {key} {value:.12g}, was {was}", as_json=as_json)
    if vehicle.keys() <= KNOWN.keys():
        return
    # numpy takes longer to load than most commands to run.
    from iort_station.operations import recompute  # noqa: PLC0415 - see above

    if wait:
        say(f"waiting {recompute.SETTLED_S:.0f} s, while Lambda 2 may still use the old parameters")
        recompute.wait_until_settled()
    streams = dict.fromkeys([*recompute.streams(cloud, name, from_us), *(also or ())])
    for stream in streams:
        with reading(f"{name} {stream}", from_us, time.time_ns() // 1000) as progress:
            done = recompute.recompute(cloud, name, stream, from_us, progress=progress)
        facts = {"robot": name, "stream": stream, "seconds": done.seconds, "left_out": done.left_out}
        tell(facts, f"{name} {stream}: {done.seconds:,} seconds recomputed", as_json=as_json)
        if done.left_out:
            say(f"{done.left_out} stored items are in no summary: not a batch, or too many samples")
    if not streams:
        say(f"{name}: 0 seconds recomputed: no summary has a speed")


@commands.command("list", epilog=examples("robots list"))
def list_(context: typer.Context, as_json: AsJson = False) -> None:
    """List the registered robots: their connections and parameters."""
    cloud = context.obj.cloud()
    rows = sorted(robots.listed(cloud), key=lambda row: str(row[ROBOT]))
    stoppable = {name: one.stoppable for name, one in _motion(cloud, rows).items()}
    if as_json:
        print_json([{**_as_json(row), "stoppable": stoppable.get(str(row[ROBOT]))} for row in rows])
        return
    if not rows:
        errors.print("no robot is registered; `iort robots add NAME` registers one")
        return
    table = Table(box=None, pad_edge=False)
    # A name must be complete to be copied; long parameters have a second line.
    table.add_column("robot", min_width=max(len(str(row[ROBOT])) for row in rows))
    for heading in ("connection", "stop", "agent", "parameters"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        stop = _STOPPABLE[stoppable.get(str(row[ROBOT]))]
        table.add_row(row[ROBOT], _connection(row), stop, row.get(AGENT_VERSION, ""), _parameters(row))
    (out if out.is_terminal else Console(width=_PIPE_WIDTH)).print(table)
    if moving := [str(row[ROBOT]) for row in rows if stoppable.get(str(row[ROBOT])) is False]:
        say(f"an emergency stop does NOT stop {', '.join(moving)}: {NO_MOTION}")


@commands.command("show", epilog=examples("robots show car7"))
def show(
    context: typer.Context,
    name: Robot,
    as_json: AsJson = False,
) -> None:
    """Show a robot: its connection, its share of Lambda 2, its provisioning, its certificates."""
    cloud = context.obj.cloud()
    row, held = registry.get(cloud, name), identity.certificates(cloud, name)
    over, motion = control.over_share(cloud, name), stopping.motion(cloud, [name])[name]
    if as_json:
        print_json(
            {
                **_as_json(row),
                "stoppable": motion.stoppable,
                OVER_SHARE: over
                and {
                    "batches": over.batches,
                    **stamped("since", over.since_ms * 1000),
                    **stamped("last", over.last_ms * 1000),
                },
                "certificates": [
                    {
                        "id": one.id,
                        "arn": one.arn,
                        "status": one.status,
                        **stamped("created", time_us(one.created, 0)),
                        **stamped("expires", None if one.expires is None else time_us(one.expires, 0)),
                    }
                    for one in held
                ],
            }
        )
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    # An identifier must be complete to be copied.
    table.add_column(overflow="fold")
    table.add_row("connection", _connection(row))
    table.add_row("stop", motion.why_not or "an emergency stop ends its motion")
    if over is not None:
        since, last = (iso_s(at_ms * 1000) for at_ms in (over.since_ms, over.last_ms))
        text = f"over: {over.batches} batches put off since {since}, the last at {last}"
        table.add_row("share", text)
    for key, value in sorted(row.items()):
        if key != ROBOT:
            table.add_row(key, _value(key, value))
    for one in held:
        until = f", expires {_time(one.expires)}" if one.expires else ""
        table.add_row("certificate", f"{one.id} {one.status}, made {_time(one.created)}{until}")
    out.print(table)


@commands.command("remove", epilog=examples("robots remove car8 --yes"))
def remove(
    context: typer.Context,
    name: Annotated[
        str | None, typer.Argument(help="The robot; not with --all.", autocompletion=completion.robots)
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Remove every robot and lasting claim, before `make destroy`.")
    ] = False,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Revoke a robot's certificates, end its session and forget it. Its data stays."""
    if everything == (name is not None):
        raise UsageError("give a robot's name, or --all")
    cloud = context.obj.cloud()
    if name is not None:
        registry.get(cloud, name)
        agreed(f"Remove {name} and revoke its certificates?", yes=yes)
        robots.remove(cloud, name)
        tell({"removed": name}, f"{name} is removed", as_json=as_json)
        return
    names = sorted(str(row[ROBOT]) for row in robots.listed(cloud))
    agreed(f"Remove {len(names)} robots and every lasting claim?", yes=yes)
    for one in names:
        robots.remove(cloud, one)
        tell({"removed": one}, f"{one} is removed", as_json=as_json)
    count = identity.revoke_claims(cloud)
    tell({"claims_revoked": count}, f"lasting claims revoked: {count}", as_json=as_json)


def _motion(cloud: Cloud, rows: Iterable[Mapping[str, Any]]) -> Mapping[str, stopping.Motion]:
    """Of robots whose shadows may be read."""
    try:
        return stopping.motion(cloud, [str(row[ROBOT]) for row in rows])
    except ClientError as error:
        say(f"whether a stop ends their motion cannot be read: {error}")
        return {}


def _parameter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise UsageError(f"must be PARAMETER=NUMBER, got {text!r}") from error


def _as_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """A robot's row with every attribute that an operator may use; null is not known."""
    known = dict.fromkeys((ROBOT, *robots.F1TENTH, *PRESENCE, *ADMISSION, *DAYS))
    told = {**known, **row, ONLINE: bool(row.get(ONLINE)), STREAMS: row.get(STREAMS, [])}
    told |= {name: float(row[name]) for name in (*robots.F1TENTH, *KNOWN) if name in row}
    for name in (CONNECTED_MS, DISCONNECTED_MS, LAST_SEEN_MS, ADMITTED_MS):
        at_ms = told.pop(name)
        told |= stamped(name.removesuffix("_ms"), None if at_ms is None else int(at_ms) * 1000)
    until_s = told.pop(ADMIT_UNTIL_S)
    told |= stamped("admit_until", None if until_s is None else int(until_s) * 1_000_000)
    for name in [name for name in told if name.startswith(ALERT_PREFIX)]:
        told |= stamped(name, int(told[name]) * 1_000_000)
    return {name: value for name, value in told.items() if name not in _INTERNAL}


def _connection(row: Mapping[str, Any]) -> str:
    if row.get(ONLINE):
        return f"online since {_value(CONNECTED_MS, row[CONNECTED_MS])}"
    if DISCONNECTED_MS in row:
        reason = row.get(DISCONNECT_REASON, "")
        return f"offline since {_value(DISCONNECTED_MS, row[DISCONNECTED_MS])} {reason}".rstrip()
    if ADMIT_UNTIL_S in row and ADMITTED_CERTIFICATE not in row:
        late = float(row[ADMIT_UNTIL_S]) < time.time()
        return f"{'was expected' if late else 'expected'} until {_value(ADMIT_UNTIL_S, row[ADMIT_UNTIL_S])}"
    return "never connected"


def _parameters(row: Mapping[str, Any]) -> str:
    known = {ROBOT, GAIN_SET_MS, *DAYS, STREAMS, *PRESENCE, *ADMISSION}
    return ", ".join(
        f"{key} {value}"
        for key, value in sorted(row.items())
        if key not in known and not key.startswith((ALERT_PREFIX, ASKED_PREFIX))
    )


def _value(key: str, value: Any) -> str:
    if key.endswith("_ms"):
        return iso_s(int(value) * 1000)
    return iso_s(int(value) * 1_000_000) if key == ADMIT_UNTIL_S else str(value)


def _time(when: Any) -> str | None:
    return None if when is None else iso_s(time_us(when, 0))
