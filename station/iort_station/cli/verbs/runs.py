"""`iort runs` and `streams`: when a robot's agent ran, what it recorded, and what is stored of it."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.padding import Padding
from rich.table import Table

from iort_contract.messages.page import Run
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot, When, examples, option, ranged, say, say_archived
from iort_station.cloud import Cloud
from iort_station.times import between, between_hours, iso, iso_s

if TYPE_CHECKING:
    from iort_analysis.archive.stored import Origin
    from iort_station.operations.audit import Missing

commands = typer.Typer()
# The missing batches of a run and stream.
Gaps = dict[tuple[str, str], "list[Missing]"]


@commands.command("runs", epilog=examples("runs car7", "runs car7 --last 7d --gaps"))
@ranged
def runs(
    context: typer.Context,
    robot: Robot,
    when: When,
    count: Annotated[int, option("The most runs to list; the newest.", min=1, max=1000)] = 20,
    with_gaps: Annotated[
        bool, option("Count missing batches; reads every batch of the listed runs.", "--gaps")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the runs of a robot's agent, newest first: start, duration, samples and losses.

    The command reads about four batches of each stream and run, never all samples. Samples are counted by the
    agent, up to its last report (every 30 s, and at a proper end). Lost is what the agent says it could not
    record.
    """
    # numpy takes longer to load than TAB may take.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - see above
    from iort_station.data.runs import runs as find  # noqa: PLC0415 - as above

    within, cloud, origin = when.range(), context.obj.cloud(), Origin()
    gaps: Gaps = {}
    with errors.status("reading") as status:
        start_us, end_us = within.start_us, within.end_us
        found = find(cloud, robot, start_us=start_us, end_us=end_us, count=count, origin=origin)
        for run in found["runs"] if with_gaps else ():
            status.update(f"counting the batches of {run['run'][:8]}")
            gaps |= _gaps(cloud, robot, run, origin)
    archived = _of(found["runs"], origin).told()
    if as_json:
        listed = [_as_json(run, gaps if with_gaps else None) for run in found["runs"]]
        of_archive = archived and between_hours(archived)
        print_json({"robot": robot, "runs": listed, "more_runs": found["older"], "archive": of_archive})
        return
    if not found["runs"]:
        errors.print(f"{robot} has no runs in this range")
        return
    out.print(_table(found["runs"], gaps if with_gaps else None))
    for (boot, stream), missing in gaps.items():
        for gap in missing:
            after = "the start" if gap.after_us is None else iso(gap.after_us)
            before = "the end" if gap.before_us is None else iso(gap.before_us)
            out.print(f"{boot[:8]} {stream}: {gap.batches:,} batches missing between {after} and {before}")
    if found["older"]:
        say(f"there are older runs: --count {2 * count}, or --to {iso_s(found['runs'][-1]['from_us'])}")
    say_archived(archived)


def _of(found: list[Run], origin: Origin) -> Origin:
    """The hours of the listed runs: the oldest batch of each stream is read, too."""
    start_us = min((run["from_us"] for run in found), default=None)
    return origin.within(start_us, max((run["to_us"] for run in found), default=None))


def _gaps(cloud: Cloud, robot: str, run: Run, origin: Origin) -> Gaps:
    from iort_station.operations import audit  # noqa: PLC0415 - as above

    return {
        (run["run"], stream): one.missing
        for stream, part in run["streams"].items()
        for one in audit.audit(
            stream, audit.headers(cloud, robot, stream, part["from_us"], part["to_us"], origin=origin)
        ).runs
        if one.boot == run["run"]
    }


def _table(found: list[Run], gaps: Gaps | None) -> Table:
    table = Table(box=None, pad_edge=False, collapse_padding=True)
    for heading, justify in (
        ("start (UTC)", "left"),
        ("duration", "right"),
        ("run", "left"),
        ("state", "left"),
    ):
        table.add_column(heading, justify=justify, no_wrap=True)  # type: ignore[arg-type]  # rich's Literal
    for heading in ("stream", "samples", "batches", "missing", "lost"):
        if heading != "missing" or gaps is not None:
            # A long name takes a second line, so that a terminal of 80 characters shows every figure.
            of_stream = heading == "stream"
            table.add_column(
                heading, justify="left" if of_stream else "right", no_wrap=not of_stream, overflow="fold"
            )
    for run in found:
        lasted = timedelta(seconds=round((run["to_us"] - run["from_us"]) / 1e6))
        head = [iso_s(run["from_us"]).replace("T", " ")[:-1], str(lasted), run["run"][:8], run["state"]]
        lost = f"{run['lost']:,}" if run["lost"] else ""
        if not run["streams"]:
            table.add_row(*head, "nothing recorded", *[""] * (2 + (gaps is not None)), lost)
        for stream, part in run["streams"].items():
            samples = "-" if part["samples"] is None else f"{part['samples']:,}"
            missing = [] if gaps is None else [f"{_count(gaps, run['run'], stream):,}"]
            table.add_row(*head, stream, samples, f"{part['batches']:,}", *missing, lost)
            head, lost = [""] * len(head), ""
    return table


def _as_json(run: Run, gaps: Gaps | None) -> dict[str, Any]:
    streams = {
        stream: {
            **between(part),
            "samples": part["samples"],
            "batches": part["batches"],
            "missing": None if gaps is None else _count(gaps, run["run"], stream),
        }
        for stream, part in run["streams"].items()
    }
    seconds = (run["to_us"] - run["from_us"]) / 1e6
    said = {"run": run["run"], **between(run), "seconds": seconds, "state": run["state"], "lost": run["lost"]}
    return {**said, "streams": streams}


def _count(gaps: Gaps, boot: str, stream: str) -> int:
    return sum(gap.batches for gap in gaps.get((boot, stream), ()))


# `iort streams`: what is stored of a robot.

if TYPE_CHECKING:
    from iort_station.data.runs import StreamOverview


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
        found = overview(cloud, robot, origin=origin)
    archived = origin.told()
    if as_json:
        listed = [_as_json_streams(one) for one in found]
        print_json({"robot": robot, "streams": listed, "archive": archived and between_hours(archived)})
        return
    if not found:
        errors.print(f"{robot} has sent nothing yet")
    for one in found:
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, unit in one.fields.items():
            table.add_row(name, unit)
        counted = f"{one.runs}{'+' if one.older else ''} {'run' if one.runs == 1 else 'runs'}"
        extent = f"{iso_s(one.extent['from_us'])} to {iso_s(one.extent['to_us'])}"
        out.print(f"{one.stream}: {counted}, {extent}", style="bold", soft_wrap=True)
        out.print(Padding(table, (0, 0, 1, 2)))
    say_archived(archived)


def _as_json_streams(one: StreamOverview) -> dict[str, Any]:
    fields = [{"name": name, "unit": unit or None} for name, unit in one.fields.items()]
    counted = {"runs": one.runs, "more_runs": one.older}
    return {"stream": one.stream, **between(one.extent), **counted, "fields": fields}
