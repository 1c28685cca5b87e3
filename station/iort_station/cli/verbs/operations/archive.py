"""`iort archive`: telemetry that is kept for good, as Parquet."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.progress import MofNCompleteColumn

from iort_contract.topics import parse_topic
from iort_station.cli import completion, console
from iort_station.cli.options import AsJson
from iort_station.cli.progress import bar
from iort_station.cli.words import examples, say
from iort_station.data.recorded import archive_of
from iort_station.errors import StationError
from iort_station.operations import archive

commands = typer.Typer(
    name="archive", no_args_is_help=True, help="Telemetry that is kept for good, as Parquet in the bucket."
)

_EMPTY = "nothing is archived yet: an hour is, from a quarter past the next one"

_Robot = Annotated[
    str | None,
    typer.Argument(help="Only this robot; needed for a removed one.", autocompletion=completion.robots),
]
_Stream = Annotated[str | None, typer.Argument(help="Only this stream.", autocompletion=completion.streams)]


@commands.command("show", epilog=examples("archive show car7"))
def show(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """List the streams in the archive: hours, samples, bytes."""
    cloud = context.obj.cloud()
    streams: list[dict[str, Any]] = []
    for topic in archive.topics(cloud, robot, stream):
        rows = list(archive_of(cloud, topic).rows())
        if not rows:
            continue
        name = parse_topic(topic)
        # The hours of a day are one object.
        size = sum({row.key: row.size_bytes for row in rows}.values())
        facts = {
            "robot": name.robot,
            "stream": name.name,
            "first": rows[0].hour,
            "last": rows[-1].hour,
            "hours": len(rows),
            "batches": sum(row.batches for row in rows),
            "samples": sum(row.samples for row in rows),
            "refused": sum(row.refused for row in rows),
            "bytes": size,
        }
        streams.append(facts)
        if not as_json:
            text = (
                f"{name.robot} {name.name}: {len(rows):,} hours from {rows[0].hour} to {rows[-1].hour}, "
                f"{facts['samples']:,} samples, {size:,} bytes"
            )
            console.out.print(text, soft_wrap=True)
    if as_json:
        console.print_json(streams)
    elif not streams:
        say(_EMPTY)


@commands.command("run", epilog=examples("archive run", "archive run car7 vesc"))
def run(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """Archive now what the schedule would in the next hours, and wait for it. The current hour stays."""
    cloud = context.obj.cloud()
    topics = archive.topics(cloud, robot, stream)
    with bar("looking for hours", len(topics), MofNCompleteColumn()) as progress:
        hours = 0
        for topic in topics:
            hours += archive.run(cloud, topic)
            progress(1)
    if hours:
        with bar("archiving", hours, MofNCompleteColumn()) as progress:
            done = 0

            def tell(left: int) -> None:
                nonlocal done
                progress(max(0, hours - left) - done)
                done = max(0, hours - left)

            archive.wait(cloud, tell)
    console.tell({"hours": hours}, f"{hours} hours done", as_json=as_json)


@commands.command("verify", epilog=examples("archive verify", "archive verify car7 vesc"))
def verify(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """Prove that the archive holds every batch: compare table, manifest and objects. All of it is read.

    Fails if anything is missing. `iort doctor --deep` looks at every stream, and at files.
    """
    cloud = context.obj.cloud()
    wrong, streams = 0, []
    for topic in archive.topics(cloud, robot, stream):
        name, found = parse_topic(topic), archive.verify(cloud, topic)
        problems = {hour: f"{count} batches are not archived" for hour, count in found.lacking.items()}
        problems |= found.damaged
        wrong += len(problems)
        if not found.hours and not problems:
            continue
        facts = {"hours": found.hours, "samples": found.samples, "problems": problems}
        facts |= {"refused": found.refused.count, "named": found.refused.named}
        streams.append({"robot": name.robot, "stream": name.name, **facts})
        lines = [f"{name.robot} {name.name}: {found.hours:,} hours, {found.samples:,} samples"]
        lines += [f"    {hour}: {problem}" for hour, problem in problems.items()]
        lines += [f"    cannot be decoded: {line}" for line in found.refused.named]
        if not as_json:
            for line in lines:
                console.out.print(line, soft_wrap=True)
    if as_json:
        console.print_json(streams)
    elif not streams:
        say(_EMPTY)
    if wrong:
        raise StationError(
            f"{wrong} hours are not as they should be: `iort archive run`, then look at `iort alarms`"
        )
