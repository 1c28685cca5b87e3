"""`iort adopt`: batches of another table into the telemetry table."""

from __future__ import annotations

import json
from typing import Annotated

import typer
from rich.progress import Progress

from iort_contract.limits import ContractError
from iort_contract.topics import check_robot
from iort_station.cli.console import Console
from iort_station.cli.progress import say
from iort_station.errors import StationError
from iort_station.recordings import adopt
from iort_station.recordings.adopt import Adoption

commands = typer.Typer()
_out = Console()
_notes = Console(stderr=True)
# How many of the items that are left are listed.
_LISTED = 20


@commands.command("adopt")
def adopt_(
    context: typer.Context,
    table: Annotated[
        str | None,
        typer.Argument(
            metavar="TABLE",
            help="Such as one restored from a backup. Default: the one kept by old_telemetry.",
        ),
    ] = None,
    robot: Annotated[str | None, typer.Option(help="Of this robot alone.")] = None,
    units: Annotated[
        int,
        typer.Option(min=1, help="Write units (1 KB) a second. A stream takes 1,000, its robot's included."),
    ] = adopt.UNITS_PER_S,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Copy batches from an old telemetry table, or from one restored from a backup, into the deployment's.

    The other table stays as it is, and doing it again changes nothing. Lambda 2 makes the summaries again.
    Exit status 1 if some items cannot be adopted; they are told with the reason. See docs/upgrading.md.
    """
    cloud = context.obj.cloud()
    try:
        name = None if robot is None else check_robot(robot)
    except ContractError as error:
        raise StationError(str(error)) from error
    source, count = adopt.source_table(cloud, table)
    with Progress(console=_notes, transient=True, disable=not _notes.is_terminal) as bar:
        task = bar.add_task(f"reading {source}", total=count or None)
        done = adopt.adopt(
            cloud,
            source,
            robot=name,
            units_per_s=units,
            dry_run=dry_run,
            progress=lambda items: bar.advance(task, items),
        )
    if as_json:
        _out.print_json(json.dumps(_as_json(done)))
    else:
        _show(done, "would be adopted" if dry_run else "adopted")
    if done.batches and not dry_run:
        say("Lambda 2 makes their summaries now; `iort audit ROBOT` says whether all is there")
    raise typer.Exit(1 if done.left else 0)


def _show(done: Adoption, what: str) -> None:
    for (robot, stream), count in sorted(done.batches.items()):
        samples = done.samples[robot, stream]
        _out.print(f"{robot} {stream}: {count:,} batches of {samples:,} samples {what}")
    for left in done.left[:_LISTED]:
        _out.print(f"{left.topic} at {left.key}: {left.cause}", style="red", soft_wrap=True)
    if len(done.left) > _LISTED:
        _out.print(f"and {len(done.left) - _LISTED:,} more; --json has them all")
    total, cannot = done.batches.total(), len(done.left)
    _out.print(f"{total:,} batches {what}, {cannot:,} cannot be, {done.expired:,} have expired")


def _as_json(done: Adoption) -> dict[str, object]:
    return {
        "adopted": [
            {"robot": robot, "stream": stream, "batches": count, "samples": done.samples[robot, stream]}
            for (robot, stream), count in sorted(done.batches.items())
        ],
        "left": [left._asdict() for left in done.left],
        "expired": done.expired,
    }
