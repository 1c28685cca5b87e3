"""`iort import`: recordings, as if the robot had driven."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.filesize import decimal
from rich.progress import DownloadColumn, MofNCompleteColumn, TransferSpeedColumn

from iort_contract.tables import DEFAULT_RETENTION_DAYS
from iort_station.cli.console import bar, counted, errors, out, print_json, table
from iort_station.cli.options import AsJson, DryRun, Robot, argument, examples, option, resumable
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.times import iso_s, time_us

if TYPE_CHECKING:
    from iort_station.imports.plan import Plan
    from iort_station.imports.run import Outcome

commands = typer.Typer()
_HOUR_US = 3_600_000_000


@commands.command("import", epilog=examples("import --dry-run drive.bag car7", "import drive.bag car7"))
def import_(
    context: typer.Context,
    paths: Annotated[
        list[str],
        argument(
            "Bags of ROS 1, folders of ROS 2, .db3, .mcap, logs of VESC Tool; folders of these, or patterns.",
            metavar="RECORDING...",
        ),
    ],
    robot: Robot,
    config: Annotated[
        Path | None, option("The car.yaml of the robot's agent: import what it would have recorded.")
    ] = None,
    topics: Annotated[
        list[str] | None,
        option("Only this topic, or topics like it: '/camera/*'. May be repeated.", "--topic"),
    ] = None,
    large: Annotated[
        Literal["refuse", "upload"],
        option(
            "Large arrays, such as images: leave the message out if it is too large, or upload them as files."
        ),
    ] = "refuse",
    start: Annotated[
        str | None, option("The time of the first message, where the recording's clock was not set.")
    ] = None,
    archive: Annotated[
        bool,
        option(
            "Straight into the archive; the default for drives that the table would not keep.", "--archive"
        ),
    ] = False,
    overlap: Annotated[
        bool, option("Import what overlaps recorded data, or is imported for another robot.", "--overlap")
    ] = False,
    units: Annotated[
        int, option("Speed into the table, in write units of DynamoDB (1 KB) a second.", min=1)
    ] = 500,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Import recordings of a robot, as if it had driven: with numbers, runs, audit, and their own times.

    Recent drives go into the table, old ones into the archive. A recording that is imported already is left
    alone, and an interrupted import goes on. What is damaged is imported up to where it is good. --dry-run
    says what would come, and what it costs on AWS. Exit status 1 if a recording was refused. See
    docs/how-to/import.md.
    """
    # numpy takes longer to load than TAB may take.
    from iort_station.imports import plan as planning  # noqa: PLC0415 - see above
    from iort_station.imports.choice import Choice, configured  # noqa: PLC0415 - as above
    from iort_station.imports.run import run  # noqa: PLC0415 - as above

    context.with_resource(_silent_reader())
    cloud = context.obj.cloud()
    registry.get(cloud, robot)
    choice = Choice(only=tuple(topics or ()), upload=large == "upload")
    if config is not None:
        choice = configured(config, robot, tuple(topics or ()))
    start_us = None if start is None else time_us(start, time.time_ns() // 1000)
    found = list(planning.recordings(paths))
    if start_us is not None and len(found) > 1:
        raise StationError(f"--start is for one recording, got {len(found)}")
    days = int(cloud.find_output("storage", "RetentionDays") or DEFAULT_RETENTION_DAYS)
    try:
        with resumable("import"):
            size = sum(
                one.stat().st_size
                for path in found
                for one in ([path] if path.is_file() else path.iterdir())
                if one.is_file()
            )
            with bar("reading", size, DownloadColumn(), TransferSpeedColumn()) as progress:
                plans = planning.look(found, choice, start_us=start_us, progress=progress)
            planning.check(cloud, robot, plans, archive=archive, overlap=overlap, retention_s=days * 86_400)
            if not as_json:
                for one in plans:
                    _show_plan(one)
            outcomes: list[Outcome] = []
            going = [one for one in plans if one.goes_on]
            if not dry_run:
                total = sum(sum(one.counts.values()) for one in going)
                with bar("importing", total, MofNCompleteColumn()) as progress:
                    outcomes = run(
                        cloud,
                        robot,
                        plans,
                        retention_s=days * 86_400,
                        units_per_s=units,
                        every_s=choice.large_every_s,
                        overlap=overlap,
                        progress=progress,
                    )
    except OSError as error:
        raise StationError(
            f"{error.filename or 'a temporary file'}: {error.strerror or error}; make room (TMPDIR names "
            "another folder for temporary files), import again, and it goes on"
        ) from error
    facts = [_facts(one) for one in plans]
    for outcome in outcomes:
        facts[plans.index(outcome.plan)].update(_outcome(outcome))
    cost = _cost(plans, days) if dry_run else None
    if as_json:
        print_json({"robot": robot, "recordings": facts, **({"cost": cost} if cost else {})})
    elif cost is not None:
        _show_cost(cost, days)
    else:
        for one in going:
            # Another import has come before it.
            if one.refused:
                _show_plan(one)
        for outcome in outcomes:
            _show_outcome(robot, outcome)
    raise typer.Exit(1 if any(one.refused for one in plans) else 0)


@contextmanager
def _silent_reader() -> Iterator[None]:
    """The outcome says what the reader of recordings would log."""
    log = logging.getLogger("iort_contract.recordings")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


def _show_plan(plan: Plan) -> None:
    if plan.refused:
        errors.print(plan.refused, style="red", soft_wrap=True)
        return
    where = "into the archive" if plan.store == "archive" else "into the table"
    state = f"{plan.there}: nothing to do" if plan.there else f"{'goes on ' if plan.begun else ''}{where}"
    out.print(
        f"{plan.path.name}: {decimal(plan.size)}, {_times(plan)}, "
        f"{counted(sum(plan.counts.values()), 'message')} of {counted(len(plan.topics), 'topic')}, {state}",
        soft_wrap=True,
    )
    for note in plan.notes:
        out.print(f"  {note}", style="yellow", soft_wrap=True)
    if plan.there:
        return
    shown = table("topic", "type", "stream", "messages", left=("topic", "type", "stream"))
    for topic, choice in sorted(plan.topics.items()):
        shown.add_row(topic, plan.kinds.get(topic, "VESC Tool"), choice.stream, f"{plan.counts[topic]:,}")
    for topic, why in sorted(plan.left_out.items()):
        shown.add_row(topic, plan.kinds.get(topic, ""), "-", why)
    out.print(shown)


def _times(plan: Plan) -> str:
    return f"{iso_s(plan.first_us)} to {iso_s(plan.last_us)}"


def _show_outcome(robot: str, outcome: Outcome) -> None:
    files = f", {counted(outcome.files, 'file')}" if outcome.files else ""
    out.print(
        f"{outcome.plan.path.name}: imported {counted(outcome.samples, 'sample')} of "
        f"{counted(len(outcome.counts), 'stream')}{files}; the run {outcome.plan.run} of {robot}",
        soft_wrap=True,
    )
    if outcome.end:
        out.print(f"  imported up to where it is good: {outcome.end}", style="yellow", soft_wrap=True)
    for line in outcome.unread.values():
        out.print(f"  {line}", style="yellow", soft_wrap=True)
    if outcome.without_time:
        out.print(
            f"  {outcome.without_time:,} samples have a time from before 2000 or after now, and are left out",
            style="yellow",
            soft_wrap=True,
        )
    for stream, counts in outcome.counts.items():
        if counts.refused:
            out.print(
                f"  {stream}: {counts.refused:,} messages are larger than a robot can send, and are left "
                f"out: {counts.why}; --large upload imports large arrays as files",
                style="yellow",
                soft_wrap=True,
            )


def _facts(plan: Plan) -> dict[str, Any]:
    return {
        "path": str(plan.path),
        "bytes": plan.size,
        "run": plan.run,
        "store": plan.store,
        "from_us": plan.first_us,
        "to_us": plan.last_us,
        "streams": plan.streams,
        "left_out": plan.left_out,
        "notes": plan.notes,
        "refused": plan.refused,
        "there": plan.there,
        "begun": plan.begun,
    }


def _outcome(outcome: Outcome) -> dict[str, Any]:
    return {
        "samples": outcome.samples,
        "stored": {stream: counts.stored for stream, counts in outcome.counts.items()},
        "too_large": {stream: counts.refused for stream, counts in outcome.counts.items() if counts.refused},
        "end": outcome.end,
        "unread": dict(outcome.unread),
        "without_time": outcome.without_time,
        "files": outcome.files,
    }


def _cost(plans: list[Plan], days: int) -> dict[str, float]:
    """Dollars at list prices: once, and for what is stored."""
    from iort_station.cost import report  # noqa: PLC0415 - only for a dry run

    once = stored = 0.0
    for plan in plans:
        if not plan.goes_on:
            continue
        # Of few messages, or if a clock was not set, no more seconds and hours than messages.
        seconds = (plan.last_us - plan.first_us) / 1e6 + 1
        hours = plan.last_us // _HOUR_US - plan.first_us // _HOUR_US + 1
        counts = plan.streams.values()
        one = report.Imported(
            sum(min(seconds, count) for count in counts),
            sum(min(hours, count) for count in counts),
            plan.size,
        )
        units = report.archive_units(one) if plan.store == "archive" else report.table_units(one, days)
        more, kept = report.import_dollars(units)
        once, stored = once + more, stored + kept
    return {"once_usd": round(once, 6), "storage_usd": round(stored, 6)}


def _show_cost(cost: dict[str, float], days: int) -> None:
    out.print(
        f"on AWS, list prices: {cost['once_usd']:.4f} USD once, and {cost['storage_usd']:.4f} USD to store "
        f"it: in the table for {days} days, in the archive for a month",
        soft_wrap=True,
    )
