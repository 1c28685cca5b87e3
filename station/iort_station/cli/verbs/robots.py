"""`iort robots`: the registered robots, their certificates, claims and tags."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.table import Table

from iort_contract import tables
from iort_contract.catalog.car import KNOWN
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.commands import NO_MOTION
from iort_station.cli import options
from iort_station.cli.console import Console, Lines, errors, out, print_json, reading, tell
from iort_station.cli.options import AsJson, Force, From, Last, Robot, When, Yes, argument, examples, option
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet import control, identity, registry, robots, stopping
from iort_station.output import check_free
from iort_station.times import iso_s, stamped, time_us

# `iort robots add, register, claim, rotate, revoke-claims`: names, certificates and provisioning claims.


_STOP = (
    "An emergency stop ends what downlink.cmd in car.yaml moves: the simulated car's command is there. Name "
    "your robot's own before you drive it (docs/how-to/drive.md)."
)
_Gain = Annotated[
    float | None,
    option(
        f"erpm per m/s (vesc.yaml). Default: {F1TENTH.speed_to_erpm_gain:g} for the page alone.",
        show_default=False,
    ),
]
_ClaimFolder = Annotated[Path, option("The folder to write the claim into.", "--out", "-o")]


commands = typer.Typer(name="robots", no_args_is_help=True, help="The robots that may connect.")


@commands.command("add", epilog=examples("robots add car8 --out robots"))
def add(
    context: typer.Context,
    name: Annotated[str, argument("The robot's name.")],
    folder: Annotated[
        Path, option("Where to write the robot's folder of configuration and keys.", "--out", "-o")
    ] = Path(),
    speed_to_erpm_gain: _Gain = None,
    as_json: AsJson = False,
) -> None:
    """Register a robot and write its folder: car.yaml, certificate and key."""
    cloud = context.obj.cloud()
    bundle = robots.add(cloud, name, out=folder, vehicle=_vehicle(speed_to_erpm_gain))
    where, config = f"Copy {bundle.folder} to it, then run there", f"{bundle.folder.name}/car.yaml"
    if cloud.mqtt_endpoint == "127.0.0.1":
        where, config = "This cloud is for robots of this machine alone; run here", str(bundle.config)
    text = f"{name} is registered. {where}:\n\n  iort-agent run --config {config}\n\n{_STOP}"
    tell(
        {"robot": name, "folder": str(bundle.folder), "config": str(bundle.config)},
        Lines(text),
        as_json=as_json,
    )


@commands.command("register", epilog=examples("robots register car20 car21 --days 7"))
def register(
    context: typer.Context,
    names: Annotated[list[str], argument("The robots' names.")],
    serial: Annotated[
        str | None, option("The serial number of the one machine that may claim the name.")
    ] = None,
    days: Annotated[float, option("How many days the name can be claimed.", min=0)] = identity.DAYS,
    speed_to_erpm_gain: _Gain = None,
    as_json: AsJson = False,
) -> None:
    """Pre-register names. Any robot with one of the fleet's lasting claims can claim each name once."""
    if serial is not None and len(names) != 1:
        raise UsageError("--serial is for one machine: give one name with it")
    cloud, vehicle = context.obj.cloud(), _vehicle(speed_to_erpm_gain)
    for name in names:
        identity.register(cloud, name, serial=serial, days=days, vehicle=vehicle)
        tell({"robot": name, "days": days}, f"{name} is expected for {days:g} days", as_json=as_json)


@commands.command("claim", epilog=examples("robots claim car9 --out claim-car9"))
def claim(
    context: typer.Context,
    name: Annotated[str | None, argument("The robot's name; not with --lasting.")] = None,
    folder: _ClaimFolder = Path("claim"),
    lasting: Annotated[bool, option("Valid until revoked, instead of five minutes.")] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a provisioning claim, which the robot exchanges for a certificate of its own key.

    The claim is for NAME alone, which this command registers or opens again. Without a name, a lasting
    claim is for the pre-registered names (`iort robots register`), once for each.
    """
    if name is None and not lasting:
        raise UsageError("give the robot's name, or --lasting for a claim of many robots")
    check_free(folder / identity.CLAIM_FILE, force=force)
    path = identity.claim(context.obj.cloud(), name, out=folder, lasting=lasting)
    text = (
        f"Copy {folder} to the robot, then run there:\n\n"
        f"  iort-agent provision --config {folder.name}/{path.name}"
    )
    tell({"robot": name, "folder": str(folder), "claim": str(path)}, Lines(text), as_json=as_json)


@commands.command("rotate", epilog=examples("robots rotate car7 --out claim-car7 --no-wait"))
def rotate(
    context: typer.Context,
    name: Robot,
    folder: _ClaimFolder = Path("claim"),
    finish: Annotated[
        bool, option("The robot has its new certificate: wait, and revoke the old.", "--finish")
    ] = False,
    wait: Annotated[bool, option("Wait for the robot, then revoke the old certificate.")] = True,
    settled_s: Annotated[
        float, option("Seconds that the robot must be connected with the new one.", min=0)
    ] = identity.SETTLED_S,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Give a robot a new key and certificate; revoke the old one after the new one is in use.

    The robot can connect at every moment. You may stop the command at any time: `--finish` does the rest.
    """
    cloud = context.obj.cloud()
    if not finish:
        registry.get(cloud, name)
        check_free(folder / identity.CLAIM_FILE, force=force)
        path = identity.claim(cloud, name, out=folder)
        text = (
            f"Copy {folder} to {name} within five minutes, then run there:\n\n"
            f"  iort-agent renew --config car.yaml --claim {folder.name}/{path.name}\n"
        )
        tell({"robot": name, "folder": str(folder), "claim": str(path)}, Lines(text), as_json=as_json)
    if finish or wait:
        with errors.status("waiting") as status:
            old = identity.finish_rotation(cloud, name, settled_s=settled_s, progress=status.update)
        text = f"{name} has settled with its new certificate; revoked: {len(old)}"
        tell({"robot": name, "revoked": len(old)}, text, as_json=as_json)


@commands.command("revoke-claims", epilog=examples("robots revoke-claims --yes"))
def revoke_claims(context: typer.Context, yes: Yes = False, as_json: AsJson = False) -> None:
    """Revoke every lasting claim. Robots that were provisioned with one keep their own certificate."""
    options.agreed("Revoke every lasting claim?", yes=yes)
    count = identity.revoke_claims(context.obj.cloud())
    tell({"claims_revoked": count}, f"lasting claims revoked: {count}", as_json=as_json)


def _vehicle(speed_to_erpm_gain: float | None) -> Mapping[str, float]:
    if speed_to_erpm_gain is None:
        return robots.F1TENTH
    own = robots.checked_vehicle({"speed_to_erpm_gain": speed_to_erpm_gain})
    return {**robots.F1TENTH, **registry.given(own)}


# `iort robots tag`: what the fleet's view groups and finds robots by.


@commands.command(
    "tag", epilog=examples("robots tag car7 lab=north team=blue", "robots tag car7 --remove team")
)
def tag(
    context: typer.Context,
    name: Robot,
    changes: Annotated[
        list[str] | None, argument("Tags to set, for example lab=north team=blue.", metavar="TAG=VALUE")
    ] = None,
    remove: Annotated[list[str] | None, option("A tag to remove; may be repeated.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show or change a robot's tags. The page finds and groups robots by them."""
    wanted: dict[str, str | None] = dict(options.assigned(text, "lab=north") for text in changes or ())
    wanted |= dict.fromkeys(remove or ())
    now = robots.change_tags(context.obj.cloud(), name, wanted)
    if as_json:
        print_json({"robot": name, "tags": now})
        return
    for key, value in now.items():
        out.print(f"{key}={value}", soft_wrap=True)


# What the cloud's functions keep in the row for themselves.
_INTERNAL = {tables.SESSION_VERSION, tables.ADMIT_CLAIM, tables.ADMIT_FINGERPRINT}
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
        list[str], argument(f"{', '.join([*robots.F1TENTH, *KNOWN])}.", metavar="PARAMETER=VALUE")
    ],
    start: From = None,
    last: Last = None,
    also: Annotated[
        list[str] | None,
        option("Another stream with a speed field, unknown by its name; may be repeated.", "--stream"),
    ] = None,
    wait: Annotated[
        bool, option("Wait a minute first. --no-wait is for a robot that was silent for a minute.")
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
        options.say(f"waiting {recompute.SETTLED_S:.0f} s, while Lambda 2 may still use the old parameters")
        recompute.wait_until_settled()
    streams = dict.fromkeys([*recompute.streams(cloud, name, from_us), *(also or ())])
    for stream in streams:
        with reading(f"{name} {stream}", from_us, time.time_ns() // 1000) as progress:
            done = recompute.recompute(cloud, name, stream, from_us, progress=progress)
        facts = {"robot": name, "stream": stream, "seconds": done.seconds, "left_out": done.left_out}
        tell(facts, f"{name} {stream}: {done.seconds:,} seconds recomputed", as_json=as_json)
        if done.left_out:
            options.say(f"{done.left_out} stored items are in no summary: not a batch, or too many samples")
    if not streams:
        options.say(f"{name}: 0 seconds recomputed: no summary has a speed")


@commands.command("list", epilog=examples("robots list"))
def list_(context: typer.Context, as_json: AsJson = False) -> None:
    """List the registered robots: their connections and parameters."""
    cloud = context.obj.cloud()
    rows = sorted(robots.listed(cloud), key=lambda row: str(row[tables.ROBOT]))
    stoppable = {name: one.stoppable for name, one in _motion(cloud, rows).items()}
    if as_json:
        print_json([{**_as_json(row), "stoppable": stoppable.get(str(row[tables.ROBOT]))} for row in rows])
        return
    if not rows:
        errors.print("no robot is registered; `iort robots add NAME` registers one")
        return
    table = Table(box=None, pad_edge=False)
    # A name must be complete to be copied; long parameters have a second line.
    table.add_column("robot", min_width=max(len(str(row[tables.ROBOT])) for row in rows))
    for heading in ("connection", "stop", "agent", "parameters"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        stop = _STOPPABLE[stoppable.get(str(row[tables.ROBOT]))]
        table.add_row(
            row[tables.ROBOT], _connection(row), stop, row.get(tables.AGENT_VERSION, ""), _parameters(row)
        )
    (out if out.is_terminal else Console(width=_PIPE_WIDTH)).print(table)
    if moving := [str(row[tables.ROBOT]) for row in rows if stoppable.get(str(row[tables.ROBOT])) is False]:
        options.say(f"an emergency stop does NOT stop {', '.join(moving)}: {NO_MOTION}")


@commands.command("show", epilog=examples("robots show car7"))
def show(context: typer.Context, name: Robot, as_json: AsJson = False) -> None:
    """Show a robot: its connection, its share of Lambda 2, its provisioning, its certificates."""
    cloud = context.obj.cloud()
    row, held = registry.get(cloud, name), identity.certificates(cloud, name)
    over, motion = control.over_share(cloud, name), stopping.motion(cloud, [name])[name]
    if as_json:
        share = over and {
            "batches": over.batches,
            **stamped("since", over.since_ms * 1000),
            **stamped("last", over.last_ms * 1000),
        }
        facts = {**_as_json(row), "stoppable": motion.stoppable, tables.OVER_SHARE: share}
        print_json({**facts, "certificates": list(map(_certificate_as_json, held))})
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
        if key != tables.ROBOT:
            table.add_row(key, _value(key, value))
    for one in held:
        until = f", expires {_time(one.expires)}" if one.expires else ""
        table.add_row("certificate", f"{one.id} {one.status}, made {_time(one.created)}{until}")
    out.print(table)


def _certificate_as_json(certificate: identity.Certificate) -> dict[str, Any]:
    expires = None if certificate.expires is None else time_us(certificate.expires, 0)
    times = stamped("created", time_us(certificate.created, 0)) | stamped("expires", expires)
    return {"id": certificate.id, "arn": certificate.arn, "status": certificate.status, **times}


@commands.command("remove", epilog=examples("robots remove car8 --yes"))
def remove(
    context: typer.Context,
    name: Annotated[str | None, argument("The robot; not with --all.", autocompletion=options.robots)] = None,
    everything: Annotated[
        bool, option("Remove every robot and lasting claim, before `make destroy`.", "--all")
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
        options.agreed(f"Remove {name} and revoke its certificates?", yes=yes)
        robots.remove(cloud, name)
        tell({"removed": name}, f"{name} is removed", as_json=as_json)
        return
    names = sorted(str(row[tables.ROBOT]) for row in robots.listed(cloud))
    options.agreed(f"Remove {len(names)} robots and every lasting claim?", yes=yes)
    for one in names:
        robots.remove(cloud, one)
        tell({"removed": one}, f"{one} is removed", as_json=as_json)
    count = identity.revoke_claims(cloud)
    tell({"claims_revoked": count}, f"lasting claims revoked: {count}", as_json=as_json)


def _motion(cloud: Cloud, rows: Iterable[Mapping[str, Any]]) -> Mapping[str, stopping.Motion]:
    """Of robots whose shadows may be read."""
    try:
        return stopping.motion(cloud, [str(row[tables.ROBOT]) for row in rows])
    except ClientError as error:
        options.say(f"whether a stop ends their motion cannot be read: {error}")
        return {}


def _parameter(text: str) -> tuple[str, float]:
    name, value = options.assigned(text, "speed_to_erpm_gain=4614")
    try:
        return name, float(value)
    except ValueError as error:
        raise UsageError(f"must be PARAMETER=NUMBER, got {text!r}") from error


def _as_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """A robot's row with every attribute that an operator may use; null is not known."""
    known = dict.fromkeys((tables.ROBOT, *robots.F1TENTH, *tables.PRESENCE, *tables.ADMISSION, *tables.DAYS))
    told = {
        **known,
        **row,
        tables.ONLINE: bool(row.get(tables.ONLINE)),
        tables.STREAMS: row.get(tables.STREAMS, []),
    }
    told |= {name: float(row[name]) for name in (*robots.F1TENTH, *KNOWN) if name in row}
    for name in (tables.CONNECTED_MS, tables.DISCONNECTED_MS, tables.LAST_SEEN_MS, tables.ADMITTED_MS):
        at_ms = told.pop(name)
        told |= stamped(name.removesuffix("_ms"), None if at_ms is None else int(at_ms) * 1000)
    until_s = told.pop(tables.ADMIT_UNTIL_S)
    told |= stamped("admit_until", None if until_s is None else int(until_s) * 1_000_000)
    for name in [name for name in told if name.startswith(tables.ALERT_PREFIX)]:
        told |= stamped(name, int(told[name]) * 1_000_000)
    return {name: value for name, value in told.items() if name not in _INTERNAL}


def _connection(row: Mapping[str, Any]) -> str:
    if row.get(tables.ONLINE):
        return f"online since {_value(tables.CONNECTED_MS, row[tables.CONNECTED_MS])}"
    if tables.DISCONNECTED_MS in row:
        since = _value(tables.DISCONNECTED_MS, row[tables.DISCONNECTED_MS])
        return f"offline since {since} {row.get(tables.DISCONNECT_REASON, '')}".rstrip()
    if tables.ADMIT_UNTIL_S in row and tables.ADMITTED_CERTIFICATE not in row:
        was = "was " if int(row[tables.ADMIT_UNTIL_S]) < time.time() else ""
        return f"{was}expected until {_value(tables.ADMIT_UNTIL_S, row[tables.ADMIT_UNTIL_S])}"
    return "never connected"


def _parameters(row: Mapping[str, Any]) -> str:
    shown = {
        tables.ROBOT,
        tables.GAIN_SET_MS,
        tables.STREAMS,
        *tables.DAYS,
        *tables.PRESENCE,
        *tables.ADMISSION,
    }
    counters = (tables.ALERT_PREFIX, tables.ASKED_PREFIX)
    others = (key for key in sorted(row) if key not in shown and not key.startswith(counters))
    return ", ".join(f"{key} {row[key]}" for key in others)


def _value(key: str, value: Any) -> str:
    if key.endswith("_ms"):
        return iso_s(int(value) * 1000)
    return iso_s(int(value) * 1_000_000) if key == tables.ADMIT_UNTIL_S else str(value)


def _time(when: Any) -> str | None:
    return None if when is None else iso_s(time_us(when, 0))
