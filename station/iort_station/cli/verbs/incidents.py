"""`iort incidents`: what robots' event recorders have kept, listed and downloaded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from iort_contract.messages.recorder import LOST, OVER_BUDGET, UPLOADED, Incident
from iort_station.cli import options
from iort_station.cli.console import bar, errors, listing, out, table
from iort_station.cli.options import AsJson, Force, OneRobot, When, argument, examples, option, ranged
from iort_station.cli.verbs.files import fetch
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet import files, registry
from iort_station.times import iso_s, stamped

if TYPE_CHECKING:
    from iort_station.data.incidents import RobotIncident


class _Listing(TyperGroup):
    """The verbs of incidents; without a verb it is `list`, so that `iort incidents car7` lists."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = next(iter(args), "")
        # TAB wants the verbs' names.
        completes = not args and ctx.resilient_parsing
        if not completes and first not in self.commands and first not in ctx.help_option_names:
            args = ["list", *args]
        return super().parse_args(ctx, args)


commands = typer.Typer(
    name="incidents",
    cls=_Listing,
    help="What robots' recorders have kept of events. Without a command it lists: `iort incidents car7`.",
)


@commands.command("list", epilog=examples("incidents list --last 7d", "incidents list car7 --json"))
@ranged
def list_(
    context: typer.Context,
    when: When,
    robot: Annotated[str | None, argument("Default: all.", autocompletion=options.robots)] = None,
    as_json: AsJson = False,
) -> None:
    """List incidents, the newest first, each in its newest state.

    kept: on the robot, not uploaded yet. uploaded: `iort incidents get` downloads it. notified: its trigger
    only tells. over_budget and lost: nothing is uploaded. Missing are messages that were there and are not in
    the file, by the account in it.
    """
    found = _found(context.obj.cloud(), robot, when.range())
    if found and not as_json:
        out.print(_table(found))
        for why in (f"{one.robot} {one.incident.id}: {one.incident.why}" for one in found if _failed(one)):
            errors.print(why, soft_wrap=True)
        return
    listing(found, as_fields, show, as_json=as_json, none="no incidents in this range")


@commands.command("get", epilog=examples("incidents get --all --robot car7 --last 7d --out incidents"))
@ranged
def get(
    context: typer.Context,
    when: When,
    which: Annotated[list[str] | None, argument("The ids of incidents.", metavar="[ID]...")] = None,
    every: Annotated[bool, option("Every uploaded incident of the range.", "--all")] = False,
    robot: OneRobot = None,
    out_folder: Annotated[
        Path, option("The folder to write the files into.", "--out", "-o", metavar="DIR")
    ] = Path(),
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Download incidents, each an MCAP file, and check the SHA-256 that the robot gave.

    An interrupted download continues. One that cannot be fetched is named, and the others are fetched; the
    exit status is then 1.
    """
    if bool(which) == every:
        raise UsageError("give the ids of incidents, or --all")
    cloud = context.obj.cloud()
    found = _found(cloud, robot, when.range())
    if every:
        chosen = [one for one in found if one.incident.state == UPLOADED]
    else:
        chosen = [_one(found, id_) for id_ in which or []]
    stored = [(one, file_of(cloud, one)) for one in chosen]
    there = [file for _, file in stored if file is not None]
    fetch(cloud, there, out_folder, force=force, as_json=as_json)
    if not chosen:
        errors.print("no uploaded incidents in this range", soft_wrap=True)
    if gone := [one.incident.id for one, file in stored if file is None]:
        raise StationError(f"not in the bucket any more: {', '.join(gone)}")


def downloaded(cloud: Cloud, id_: str, folder: Path) -> Path:
    """The file of one incident, downloaded into a folder; raises `StationError` if there is none."""
    one = _one(_found(cloud, None, options.Range(None, None)), id_)
    file = file_of(cloud, one)
    if file is None:
        raise StationError(f"the file of incident {id_} is not in the bucket any more")
    with bar(file.name, file.size) as progress:
        return files.download(cloud, file, folder, progress)


def _found(cloud: Cloud, robot: str | None, within: options.Range) -> list[RobotIncident]:
    # numpy takes longer to load than TAB may take.
    from iort_station.data.incidents import incidents  # noqa: PLC0415 - see above

    with errors.status("reading"):
        found = incidents(cloud, robot, within.start_us, within.end_us)
    if not found and robot is not None:
        registry.get(cloud, robot)
    return found


def _one(found: list[RobotIncident], id_: str) -> RobotIncident:
    one = next((one for one in found if one.incident.id == id_), None)
    if one is None:
        known = (one.incident.id for one in found)
        raise unknown(f"no incident {id_} in this range", [id_], known, "iort incidents")
    if one.incident.state != UPLOADED:
        why = f": {one.incident.why}" if one.incident.why else ""
        raise StationError(f"incident {id_} of {one.robot} is not uploaded, but {_state(one.incident)}{why}")
    return one


def file_of(cloud: Cloud, one: RobotIncident) -> files.StoredFile | None:
    """The file of an incident; None if the bucket does not have it. The robot itself has named the key."""
    try:
        file = files.stored(cloud, one.incident.key)
    except StationError:
        return None
    return file if file is not None and file.robot == one.robot else None


def _failed(one: RobotIncident) -> bool:
    return one.incident.state in {LOST, OVER_BUDGET} and bool(one.incident.why)


def _table(found: list[RobotIncident]) -> Any:
    left = ("begin (UTC)", "robot", "trigger", "state", "id")
    shown = table("begin (UTC)", "robot", "trigger", "state", "size", "missing", "id", left=left)
    # In a narrow terminal the time takes a second line, and long names do.
    for column, least in ((0, 10), (1, 4), (2, 4)):
        shown.columns[column].no_wrap, shown.columns[column].min_width = False, least
    for one in found:
        incident = one.incident
        shown.add_row(
            iso_s(incident.from_us).replace("T", " ")[:-1],
            one.robot,
            incident.trigger,
            _state(incident),
            size(incident) if incident.bytes else "",
            f"{incident.missing:,}" if incident.missing else "",
            incident.id,
        )
    return shown


def show(one: RobotIncident) -> None:
    """Print an incident in a line."""
    incident = one.incident
    parts = [iso_s(incident.from_us), one.robot, incident.trigger, _state(incident), incident.id]
    parts += [f"{size(incident)}, {incident.messages:,} messages"] if incident.bytes else []
    parts += [incident.why] if incident.why else []
    out.print("  ".join(parts), soft_wrap=True)


def _state(incident: Incident) -> str:
    return incident.state.replace("_", " ")


def size(incident: Incident) -> str:
    """The size of its file."""
    return f"{incident.bytes / 1e6:,.1f} MB" if incident.bytes >= 1e6 else f"{incident.bytes / 1e3:,.0f} kB"


def as_fields(one: RobotIncident) -> dict[str, Any]:
    """An incident for JSON."""
    fields = dict(vars(one.incident))
    times = {**stamped("from", fields.pop("from_us")), **stamped("to", fields.pop("to_us"))}
    return {"robot": one.robot, **fields, **times, **stamped("changed", one.t_us)}
