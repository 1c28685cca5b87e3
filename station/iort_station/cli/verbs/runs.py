"""`iort runs` and `streams`: when a robot's agent ran, what it recorded, and what is stored of it."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.padding import Padding
from rich.table import Table

from iort_contract.messages.page import Run
from iort_station.cli.console import errors, out, tell
from iort_station.cli.console import table as table_of
from iort_station.cli.options import AsJson, Robot, When, examples, option, ranged, say, say_archived
from iort_station.times import between, between_hours, iso_s

if TYPE_CHECKING:
    from iort_station.data.runs import StreamOverview

commands = typer.Typer()


@commands.command("runs", epilog=examples("runs car7", "runs car7 --last 7d"))
@ranged
def runs(
    context: typer.Context,
    robot: Robot,
    when: When,
    count: Annotated[int, option("The most runs to list; the newest.", min=1, max=1000)] = 20,
    as_json: AsJson = False,
) -> None:
    """List the runs of a robot's agent, newest first: start, duration, samples and losses.

    The command reads about four batches of each stream and run, never all samples. Samples are counted by the
    agent, up to its last report (every 30 s, and at a proper end). Lost is what the agent says it could not
    record. `iort audit` counts missing batches.
    """
    # numpy takes longer to load than TAB may take.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - see above
    from iort_station.data.runs import runs as find  # noqa: PLC0415 - as above

    within, cloud, origin = when.range(), context.obj.cloud(), Origin()
    with errors.status("reading"):
        answer = find(
            cloud, robot, start_us=within.start_us, end_us=within.end_us, count=count, origin=origin
        )
    rows = answer["runs"]
    # The oldest batch of each stream is read, too.
    start_us = min((run["from_us"] for run in rows), default=None)
    archived = origin.within(start_us, max((run["to_us"] for run in rows), default=None)).told()
    facts = {
        "robot": robot,
        "runs": list(map(_as_json, rows)),
        "more_runs": answer["older"],
        "archive": archived and between_hours(archived),
    }
    tell(facts, lambda: _show_runs(robot, rows), as_json=as_json, indented=True)
    if as_json:
        return
    if answer["older"]:
        say(f"there are older runs: --count {2 * count}, or --to {iso_s(rows[-1]['from_us'])}")
    say_archived(archived)


def _show_runs(robot: str, rows: list[Run]) -> None:
    if not rows:
        errors.print(f"{robot} has no runs in this range")
        return
    left = ("start (UTC)", "run", "state", "stream")
    table = table_of(
        "start (UTC)", "duration", "run", "state", "stream", "samples", "batches", "lost", left=left
    )
    # A long name takes a second line, so that a terminal of 80 characters shows every figure.
    table.columns[4].no_wrap = False
    table.columns[4].overflow = "fold"
    for run in rows:
        lasted = timedelta(seconds=round((run["to_us"] - run["from_us"]) / 1e6))
        cells = [iso_s(run["from_us"]).replace("T", " ")[:-1], str(lasted), run["run"][:8], run["state"]]
        lost = f"{run['lost']:,}" if run["lost"] else ""
        if not run["streams"]:
            table.add_row(*cells, "nothing recorded", "", "", lost)
        for stream, part in run["streams"].items():
            samples = "-" if part["samples"] is None else f"{part['samples']:,}"
            table.add_row(*cells, stream, samples, f"{part['batches']:,}", lost)
            cells, lost = [""] * len(cells), ""
    out.print(table)


def _as_json(run: Run) -> dict[str, Any]:
    streams = {
        stream: {**between(part), "samples": part["samples"], "batches": part["batches"]}
        for stream, part in run["streams"].items()
    }
    seconds = (run["to_us"] - run["from_us"]) / 1e6
    about = {
        "run": run["run"],
        **between(run),
        "seconds": seconds,
        "state": run["state"],
        "lost": run["lost"],
    }
    return {**about, "streams": streams}


@commands.command("streams", epilog=examples("streams car7"))
def streams(context: typer.Context, robot: Robot, as_json: AsJson = False) -> None:
    """List a robot's streams: their fields with units, their runs, their first and last sample.

    The command reads some batches of each run, never all samples. The fields are those of the newest batch.
    """
    # numpy takes longer to load than TAB may take.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_station.data.runs import overview  # noqa: PLC0415 - see above

    cloud, origin = context.obj.cloud(), Origin()
    with errors.status("reading"):
        rows = overview(cloud, robot, origin=origin)
    archived = origin.told()
    listed = list(map(_stream_as_json, rows))
    facts = {"robot": robot, "streams": listed, "archive": archived and between_hours(archived)}
    tell(facts, lambda: _show_streams(robot, rows), as_json=as_json, indented=True)
    if not as_json:
        say_archived(archived)


def _show_streams(robot: str, rows: list[StreamOverview]) -> None:
    if not rows:
        errors.print(f"{robot} has sent nothing yet")
    for row in rows:
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, unit in row.fields.items():
            table.add_row(name, unit)
        counted = f"{row.runs}{'+' if row.older else ''} {'run' if row.runs == 1 else 'runs'}"
        extent = f"{iso_s(row.extent['from_us'])} to {iso_s(row.extent['to_us'])}"
        out.print(f"{row.stream}: {counted}, {extent}", style="bold", soft_wrap=True)
        out.print(Padding(table, (0, 0, 1, 2)))


def _stream_as_json(row: StreamOverview) -> dict[str, Any]:
    fields = [{"name": name, "unit": unit or None} for name, unit in row.fields.items()]
    counted = {"runs": row.runs, "more_runs": row.older}
    return {"stream": row.stream, **between(row.extent), **counted, "fields": fields}
