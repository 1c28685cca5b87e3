"""`iort adopt`: batches of another table into the telemetry table."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, DryRun, OneRobot
from iort_station.cli.progress import bar
from iort_station.cli.words import examples, say
from iort_station.fleet import registry
from iort_station.recordings import adopt
from iort_station.recordings.adopt import Adoption

commands = typer.Typer()
# How many of the items that cannot be adopted are listed.
_LISTED = 20


@commands.command("adopt", epilog=examples("adopt telemetry-restored --dry-run"))
def adopt_(
    context: typer.Context,
    table: Annotated[str, typer.Argument(metavar="TABLE", help="For example one restored from a backup.")],
    robot: OneRobot = None,
    units: Annotated[
        int,
        typer.Option(min=1, help="Speed in write units of DynamoDB (1 KB) a second. A stream takes 1,000."),
    ] = adopt.UNITS_PER_S,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Copy batches from another telemetry table, such as one restored from a backup, into the deployment's.

    The other table stays as it is, and a second run changes nothing. Lambda 2 makes the summaries again. Exit
    status 1 if some items cannot be adopted; each is printed with its reason. See docs/how-to/upgrading.md.
    """
    cloud = context.obj.cloud()
    name = None if robot is None else registry.checked(robot)
    count = adopt.items_in(cloud, table)
    with bar(f"reading {table}", count or None) as progress:
        done = adopt.adopt(cloud, table, robot=name, units_per_s=units, dry_run=dry_run, progress=progress)
    if as_json:
        adopted = [
            {"robot": robot, "stream": stream, "batches": count, "samples": done.samples[robot, stream]}
            for (robot, stream), count in sorted(done.batches.items())
        ]
        left = [left._asdict() for left in done.left]
        print_json({"adopted": adopted, "left": left, "expired": done.expired})
    else:
        _show(done, "would be adopted" if dry_run else "adopted")
    if done.batches and not dry_run:
        say("Lambda 2 makes their summaries now; `iort audit ROBOT` checks that everything has arrived")
    raise typer.Exit(1 if done.left else 0)


def _show(done: Adoption, what: str) -> None:
    for (robot, stream), count in sorted(done.batches.items()):
        samples = done.samples[robot, stream]
        out.print(f"{robot} {stream}: {count:,} batches of {samples:,} samples {what}")
    for left in done.left[:_LISTED]:
        out.print(f"{left.topic} at {left.key}: {left.cause}", style="red", soft_wrap=True)
    if len(done.left) > _LISTED:
        out.print(f"and {len(done.left) - _LISTED:,} more; --json prints all")
    total, cannot = done.batches.total(), len(done.left)
    out.print(f"{total:,} batches {what}, {cannot:,} cannot be, {done.expired:,} have expired")
