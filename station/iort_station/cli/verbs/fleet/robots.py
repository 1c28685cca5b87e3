"""`iort robots`: the robots that may connect."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from iort_contract.catalog.derived import F1TENTH
from iort_contract.tables import (
    ADMISSION,
    ADMIT_UNTIL_S,
    ADMITTED_CERTIFICATE,
    AGENT_VERSION,
    ALERT_PREFIX,
    CONNECTED_MS,
    DISCONNECT_REASON,
    DISCONNECTED_MS,
    FILES_BYTES,
    FILES_DAY,
    ONLINE,
    OVER_SHARE,
    PRESENCE,
    ROBOT,
    STREAMS,
)
from iort_station.cli.console import Console
from iort_station.cli.options import since_us
from iort_station.cli.progress import reading, say
from iort_station.errors import StationError
from iort_station.fleet import certificates, claims, registry, robots, rotation, shadow
from iort_station.times import iso_s, time_us

commands = typer.Typer(name="robots", no_args_is_help=True, help="The robots that may connect.")
_out, _errors = Console(), Console(stderr=True)

_WIDEST = 10_000

_GAIN = typer.Option(help="erpm per m/s (vesc.yaml).")
_CLAIM_FOLDER = typer.Option(help="The folder to write the claim into.")


@commands.command("add")
def add(
    context: typer.Context,
    name: str,
    out: Annotated[
        Path, typer.Option(help="Where the robot's folder of configuration and keys goes.")
    ] = Path(),
    speed_to_erpm_gain: Annotated[float, _GAIN] = F1TENTH.speed_to_erpm_gain,
) -> None:
    """Register a robot and write the folder that it needs: car.yaml, certificate and key."""
    bundle = robots.add(context.obj.cloud(), name, out=out, vehicle=_vehicle(speed_to_erpm_gain))
    _out.print(f"{name} is registered. Copy {bundle.folder} to it, then run there:\n")
    _out.print(f"  iort-agent run --config {bundle.folder.name}/car.yaml")


@commands.command("register")
def register(
    context: typer.Context,
    names: Annotated[list[str], typer.Argument(help="The robots' names.")],
    serial: Annotated[
        str | None, typer.Option(help="The one machine that may have the name, by its serial number.")
    ] = None,
    days: Annotated[float, typer.Option(help="How long it is expected.", min=0)] = claims.DAYS,
    speed_to_erpm_gain: Annotated[float, _GAIN] = F1TENTH.speed_to_erpm_gain,
) -> None:
    """Expect robots: each name may be had once, by any robot with one of the fleet's lasting claims."""
    if serial is not None and len(names) != 1:
        raise StationError("--serial is of one machine: give one name with it")
    cloud, vehicle = context.obj.cloud(), _vehicle(speed_to_erpm_gain)
    for name in names:
        claims.register(cloud, name, serial=serial, days=days, vehicle=vehicle)
        _out.print(f"{name} is expected for {days:g} days")


@commands.command("claim")
def claim(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="The robot's name; none for --lasting ones.")] = None,
    out: Annotated[Path, _CLAIM_FOLDER] = Path("claim"),
    lasting: Annotated[bool, typer.Option(help="Good until revoked, not for five minutes.")] = False,
) -> None:
    """Write a claim, which the robot exchanges for a certificate of its own key's.

    It is for NAME alone, registered here or opened again. Without a name, a lasting claim is for the
    names that were registered (`iort robots register`), each of them once.
    """
    if name is None and not lasting:
        raise StationError("give the robot's name, or --lasting for a claim of many robots")
    path = claims.claim(context.obj.cloud(), name, out=out, lasting=lasting)
    _out.print(f"Copy {out} to the robot, then run there:\n")
    _out.print(f"  iort-agent provision --config {out.name}/{path.name}")


@commands.command("rotate")
def rotate(
    context: typer.Context,
    name: str,
    out: Annotated[Path, _CLAIM_FOLDER] = Path("claim"),
    finish: Annotated[
        bool, typer.Option("--finish", help="The robot has its new certificate: wait, and revoke.")
    ] = False,
    wait: Annotated[bool, typer.Option(help="Wait for the robot, and revoke what is old then.")] = True,
    settled_s: Annotated[
        float, typer.Option(help="How long it must be connected with the new one, seconds.", min=0)
    ] = rotation.SETTLED_S,
) -> None:
    """Give a robot a new key and certificate; the old one is revoked once the new one is in use.

    The robot stays able to connect at every moment, and the command may be stopped at any: `--finish`
    goes on with what is left to do.
    """
    cloud = context.obj.cloud()
    if not finish:
        registry.get(cloud, name)
        path = claims.claim(cloud, name, out=out)
        _out.print(f"Copy {out} to {name} within five minutes, then run there:\n")
        _out.print(f"  iort-agent renew --config car.yaml --claim {out.name}/{path.name}\n")
    if finish or wait:
        with _errors.status("waiting") as status:
            old = rotation.finish(cloud, name, settled_s=settled_s, progress=status.update)
        _out.print(f"{name} has settled with its new certificate; revoked: {len(old)}")


@commands.command("set")
def set_(
    context: typer.Context,
    name: str,
    parameters: Annotated[
        list[str], typer.Argument(metavar="PARAMETER=VALUE", help=f"{' or '.join(robots.F1TENTH)}.")
    ],
    since: Annotated[
        str | None,
        typer.Option(help="Recompute since 10m (ago), 2h, 3d, or ISO 8601; otherwise all that is stored."),
    ] = None,
    also: Annotated[
        list[str] | None,
        typer.Option("--stream", help="A stream with a speed that is not known by name; again for more."),
    ] = None,
    wait: Annotated[
        bool, typer.Option(help="Wait a minute first; without it, for a robot that was silent for one.")
    ] = True,
) -> None:
    """Correct a robot's vehicle parameters, and the speed in the summaries that were made with the old ones.

    Queries of samples use the new ones for everything at once; summaries before --since stay as they are.
    Doing it again changes nothing, also where it was stopped.
    """
    vehicle = robots.checked_vehicle(dict(_parameter(text) for text in parameters))
    from_us = None if since is None else since_us(since)
    cloud = context.obj.cloud()
    before = registry.set_vehicle(cloud, name, vehicle)
    for key, value in vehicle.items():
        was = f"{before[key]:.12g}" if key in before else "not set"
        _out.print(f"{name}: {key} {value:.12g}, was {was}", soft_wrap=True)
    # What it reads with loads numpy, which takes longer than most commands to run.
    from iort_station.operations import recompute  # noqa: PLC0415 - see above

    if wait:
        say(f"waiting {recompute.SETTLED_S:.0f} s, in which Lambda 2 may still know the old parameters")
        recompute.wait_until_settled()
    streams = dict.fromkeys([*recompute.streams(cloud, name, from_us), *(also or ())])
    for stream in streams:
        with reading(f"{name} {stream}", from_us, time.time_ns() // 1000) as progress:
            done = recompute.recompute(cloud, name, stream, from_us, progress=progress)
        _out.print(f"{name} {stream}: {done.seconds:,} seconds recomputed", soft_wrap=True)
        if done.left_out:
            say(f"{done.left_out} stored items are in no summary: no batches, or more than a second may hold")
    if not streams:
        _out.print(f"{name}: 0 seconds recomputed, since no summary has a speed", soft_wrap=True)


@commands.command("list")
def list_(
    context: typer.Context, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False
) -> None:
    """List the registered robots: who is online, and their parameters."""
    rows = sorted(robots.listed(context.obj.cloud()), key=lambda row: str(row[ROBOT]))
    if as_json:
        _out.print_json(json.dumps(rows, default=float))
        return
    if not rows:
        _errors.print("no robot is registered; `iort robots add NAME` registers one")
        return
    table = Table(box=None, pad_edge=False)
    # Half a name is of no use to who copies it; what is long instead has a second line.
    table.add_column("robot", min_width=max(len(str(row[ROBOT])) for row in rows))
    for heading in ("connection", "agent", "parameters"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(row[ROBOT], _connection(row), row.get(AGENT_VERSION, ""), _parameters(row))
    # What reads a pipe has no edge at which a line must end.
    out = _out if _out.is_terminal else Console(width=_WIDEST)
    out.print(table)


@commands.command("show")
def show(
    context: typer.Context,
    name: str,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Show what is known of a robot: its connection, its share, its provisioning, its certificates."""
    cloud = context.obj.cloud()
    row, held = registry.get(cloud, name), certificates.attached(cloud, name)
    over = shadow.over_share(cloud, name)
    if as_json:
        described = [
            {**one._asdict(), "created": _time(one.created), "expires": _time(one.expires)} for one in held
        ]
        said = {OVER_SHARE: over and over._asdict(), "certificates": described}
        _out.print_json(json.dumps({**row, **said}, default=float))
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    # Half an identifier is of no use to who copies it.
    table.add_column(overflow="fold")
    table.add_row("connection", _connection(row))
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
    _out.print(table)


@commands.command("remove")
def remove(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="The robot; none with --all.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Every robot and lasting claim, before `make destroy`.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before --all.")] = False,
) -> None:
    """Revoke a robot's certificates, cut its session and forget it. What it has sent stays."""
    if everything == (name is not None):
        raise StationError("give a robot's name, or --all")
    cloud = context.obj.cloud()
    if name is not None:
        robots.remove(cloud, name)
        _out.print(f"{name} is removed")
        return
    names = sorted(str(row[ROBOT]) for row in robots.listed(cloud))
    if not yes and not typer.confirm(f"Remove {len(names)} robots and every lasting claim?"):
        raise typer.Exit(1)
    for one in names:
        robots.remove(cloud, one)
        _out.print(f"{one} is removed")
    _out.print(f"lasting claims revoked: {claims.revoke_all(cloud)}")


@commands.command("revoke-claims")
def revoke_claims(context: typer.Context) -> None:
    """Revoke every lasting claim. Robots that were provisioned with one keep their own certificate."""
    _out.print(f"lasting claims revoked: {claims.revoke_all(context.obj.cloud())}")


def _vehicle(speed_to_erpm_gain: float) -> dict[str, float]:
    return robots.checked_vehicle({**robots.F1TENTH, "speed_to_erpm_gain": speed_to_erpm_gain})


def _parameter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise StationError(f"must be PARAMETER=NUMBER, got {text!r}") from error


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
    known = {ROBOT, FILES_DAY, FILES_BYTES, STREAMS, *PRESENCE, *ADMISSION}
    return ", ".join(
        f"{key} {value}"
        for key, value in sorted(row.items())
        if key not in known and not key.startswith(ALERT_PREFIX)
    )


def _value(key: str, value: Any) -> str:
    if key.endswith("_ms"):
        return iso_s(int(value) * 1000)
    return iso_s(int(value) * 1_000_000) if key == ADMIT_UNTIL_S else str(value)


def _time(when: Any) -> str | None:
    return None if when is None else iso_s(time_us(when, 0))
