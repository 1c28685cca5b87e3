"""`iort analyse`, `findings` and `note`: start the analysis, list what it found, and what people wrote."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from datetime import timedelta
from functools import partial
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from iort_analysis.drives.stretches import LONGEST_US
from iort_contract.catalog.analysis import ANALYSIS_FAILED, KINDS
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.limits import MAX_AHEAD_US, ContractError
from iort_contract.messages.analysis import (
    MAX_NOTE_CHARACTERS,
    AnalysedDrive,
    AnalysisRequest,
    Estimate,
    Finding,
    Note,
    decode_request,
    encode_analysed,
    encode_finding,
    encode_request,
)
from iort_contract.page import history_link
from iort_station.cli import options
from iort_station.cli.console import errors, listing, out, tell
from iort_station.cli.options import AsJson, Robot, When, argument, examples, option, ranged, say
from iort_station.cloud import Cloud
from iort_station.data import findings as stored
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.operations.alarms import user
from iort_station.times import between, duration_us, iso_s, stamped, time_us

commands = typer.Typer()
# The range without an option.
_USUAL = "1d"


@commands.command("analyse", epilog=examples("analyse car7 --last 1d", "analyse --fleet --last 7d --wait"))
@ranged
def analyse(
    context: typer.Context,
    when: When,
    robots: Annotated[
        list[str] | None, argument("The robots.", autocompletion=options.robots, show_default=False)
    ] = None,
    fleet: Annotated[bool, option("Every registered robot.", "--fleet")] = False,
    new: Annotated[bool, option("Only drives that have not been analysed.", "--new")] = False,
    wait: Annotated[bool, option("Wait for the findings, and show how far it is.", "--wait")] = False,
    as_json: AsJson = False,
) -> None:
    """Analyse the drives of robots in the cloud, as it does every night.

    The drives with samples in the range are cut, cleaned and mined, and compared with earlier ones. Without
    --wait the command returns at once; `iort findings` prints what is found.
    """
    if bool(robots) == fleet:
        raise UsageError("name the robots, or give --fleet for all")
    cloud = context.obj.cloud()
    for robot in robots or ():
        registry.get(cloud, robot)
    request = _request(robots or [], when, again=not new)
    run = analysis.start(cloud, request)
    name = run.rpartition(":")[2]
    if not wait:
        tell({"run": name}, f"started {name}; `iort findings` prints what it finds", as_json=as_json)
        return
    done = _watched(cloud, run)
    asked: list[str | None] = list(robots) if robots else [None]
    # A drive that goes on in the range may have begun before.
    from_us = max(0, request.start_us - 2 * LONGEST_US)
    failed = [
        finding
        for robot in asked
        for finding in stored.findings(cloud, robot, from_us, request.end_us)
        if finding.kind == ANALYSIS_FAILED and finding.to_us >= request.start_us
    ]
    facts = {"run": name, "drives": done.drives or 0, "failed": len(failed), "findings": done.findings}
    text = f"drives analysed: {done.drives or 0}, findings: {done.findings}"
    if not done.drives:
        for line in _recorded(cloud, robots or stored.robots_of(cloud, None), request):
            say(line)
    for one in failed:
        say(f"{one.drive.robot}: {one.text}")
    tell(facts, f"{text}, drives failed: {len(failed)}" if failed else text, as_json=as_json)
    raise typer.Exit(1 if failed else 0)


def _request(robots: list[str], when: When, *, again: bool) -> AnalysisRequest:
    within, now_us = when.range(_USUAL), time.time_ns() // 1000
    # Without a range all drives are meant, also those of a clock that is ahead.
    end_us = now_us + MAX_AHEAD_US if within.end_us is None else within.end_us
    request = AnalysisRequest(tuple(robots), within.start_us or 0, end_us, again=again)
    try:
        return decode_request(encode_request(request), now_us)
    except ContractError as error:
        raise UsageError(str(error)) from error


def _recorded(cloud: Cloud, robots: Iterable[str], request: AnalysisRequest) -> Iterator[str]:
    """Why a range may have no drives: what each robot recorded, and when."""
    # numpy takes longer to load than most commands to run.
    from iort_station.data import inventory  # noqa: PLC0415 - see above

    for robot in robots:
        streams = [name for name in inventory.streams_of(cloud, robot) if name not in OWN_STREAMS]
        extents = [times for name in streams if (times := inventory.extent(cloud, robot, name))]
        if not extents:
            yield f"{robot}: no drives: it has recorded nothing"
            continue
        first, last = min(times[0] for times in extents), max(times[1] for times in extents)
        yield (
            f"{robot}: no drives from {iso_s(request.start_us)} to {iso_s(request.end_us)}: "
            f"it recorded from {first} to {last}"
        )


def _watched(cloud: Cloud, run: str) -> analysis.Progress:
    """Follow a run to its end; whoever looks sees the drives that are done and the time that is left."""
    last, found_s = analysis.Progress(analysis.RUNNING), 0.0
    try:
        with errors.status("finding the drives") as status:
            for last in analysis.watch(cloud, run):
                if last.drives is not None:
                    found_s = found_s or time.monotonic()
                    status.update(progress(last, time.monotonic() - found_s))
    except KeyboardInterrupt:
        say("the analysis goes on in the cloud; `iort findings` prints what it finds")
        raise
    return last


def progress(run: analysis.Progress, seconds: float) -> str:
    """How far a run is, so many seconds after its drives were found."""
    drives, done = run.drives or 0, run.done
    if done == drives:
        return f"{drives} drives analysed; comparing them with earlier ones"
    left = f", {timedelta(seconds=round(seconds / done * (drives - done)))} left" if done else ""
    return f"{done} of {drives} drives{left}"


# `iort findings`: what the analysis has found.

_STYLES = {"serious": "bold red", "warning": "yellow", "info": ""}


@commands.command("findings", epilog=examples("findings car7", "findings car7 --drives", "findings --json"))
@ranged
def findings_(
    context: typer.Context,
    when: When,
    robot: Annotated[
        str | None, argument("The robot. Default: all.", autocompletion=options.robots, show_default=False)
    ] = None,
    drives: Annotated[
        bool, option("List the analysed drives, and what could not be computed.", "--drives")
    ] = False,
    count: Annotated[int, option("The most to list; the newest.", min=1, max=10_000)] = 50,
    page: Annotated[
        str | None,
        option(
            "The page for the links, such as http://localhost:8080/. Default: the embedded cloud's.",
            metavar="URL",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List what the analysis found about drives, the newest first, with its evidence and what to do.

    An interval holds the truth in 90 of 100 cases. The link opens the page's history at the evidence. Without
    a known page it begins with #: `iort dashboard` serves the page that it belongs to.
    """
    cloud, within = context.obj.cloud(), when.range()
    if drives:
        analysed = stored.drives(cloud, robot, within.start_us, within.end_us, most=count)
        none = "no drive in this range is analysed; `iort analyse` looks now"
        count = listing(analysed, _drive_as_json, _show_drive, as_json=as_json, none=none)
    else:
        # The embedded cloud serves one.
        page = page or cloud.page or ""
        page += "/" if page and not page.endswith("/") else ""
        found = stored.findings(cloud, robot, within.start_us, within.end_us, most=count)
        none = "nothing was found in this range; `iort analyse` looks now"
        count = listing(found, partial(_as_json, page), partial(_show, page), as_json=as_json, none=none)
    if not count and robot is not None:
        registry.get(cloud, robot)


def _show(page: str, finding: Finding) -> None:
    what = (f"{finding.severity}: {finding.text}", _STYLES.get(finding.severity, ""))
    out.print(Text.assemble(f"{iso_s(finding.from_us)}  {finding.drive.robot}  ", what), soft_wrap=True)
    rows = _rows()
    if finding.effect is not None:
        rows.add_row("effect", _interval(finding.effect))
    if finding.baseline is not None:
        rows.add_row("before", _interval(finding.baseline))
    if finding.q is not None:
        rows.add_row("false", f"at most {finding.q:.2g} of such findings")
    if finding.kind in KINDS:
        rows.add_row("to do", KINDS[finding.kind].action)
    out.print(rows)
    # In one piece, to be clicked or copied.
    out.print(Text(f" evidence {history_link(page, finding)}"), soft_wrap=True)


def _rows() -> Table:
    """Rows of a name and a text, which may take several lines."""
    rows = Table(box=None, show_header=False, padding=(0, 1, 0, 0), pad_edge=True)
    rows.add_column(min_width=8)
    rows.add_column(overflow="fold")
    return rows


def _as_json(page: str, finding: Finding) -> dict[str, Any]:
    evidence = between({"from_us": finding.from_us, "to_us": finding.to_us})
    start = stamped("start", finding.drive.start_us)
    return {**encode_finding(finding), **start, **evidence, "link": history_link(page, finding)}


def _drive_as_json(analysed: AnalysedDrive) -> dict[str, Any]:
    content = encode_analysed(analysed)
    del content["job"]
    return content | {
        **stamped("start", analysed.drive.start_us),
        **stamped("end", analysed.end_us),
        **stamped("analysed", analysed.analysed_us or None),
    }


def _interval(estimate: Estimate) -> str:
    factor, unit = (100, "%") if estimate.unit == "1" else (1, estimate.unit)
    value, low, high = (each * factor for each in (estimate.value, estimate.low, estimate.high))
    return f"{value:.4g} {unit} ({low:.4g} to {high:.4g})"


def _show_drive(analysed: AnalysedDrive) -> None:
    drive, lasted_s = analysed.drive, (analysed.end_us - analysed.drive.start_us) / 1e6
    out.print(f"{iso_s(drive.start_us)}  {drive.robot}  {lasted_s:,.0f} s, {analysed.samples:,} samples")
    rows = _rows()
    for name, estimate in analysed.estimates.items():
        rows.add_row(name, _interval(estimate))
    for kind, samples in analysed.repairs.items():
        rows.add_row(f"repaired: {kind}", f"{samples:,} samples")
    names_of: dict[str, list[str]] = {}
    for name, reason in analysed.missing.items():
        names_of.setdefault(reason, []).append(name)
    for reason, names in names_of.items():
        rows.add_row("missing", f"{', '.join(names)}: {reason}", style="yellow")
    out.print(rows)


# `iort note`: what people wrote about a robot.


@commands.command(
    "note",
    epilog=examples('note car7 "changed tyre"', 'note car7 "hit the wall" --at -10m', "note car7 --last 7d"),
)
@ranged
def note(
    context: typer.Context,
    robot: Robot,
    when: When,
    text: Annotated[
        str | None, argument(f"The note, at most {MAX_NOTE_CHARACTERS} characters. Default: list.")
    ] = None,
    at: Annotated[str | None, option("The time that it is about. Default: now.", metavar="TIME")] = None,
    by: Annotated[str | None, option("Who writes it. Default: you.")] = None,
    keep: Annotated[
        str | None, option("Have the robot's recorder keep so long before it.", metavar="60s")
    ] = None,
    remove: Annotated[str | None, option("Delete the note of this id.", metavar="ID")] = None,
    count: Annotated[int, option("The most to list; the newest.", min=1, max=10_000)] = 50,
    as_json: AsJson = False,
) -> None:
    """Write a note about a robot, or list its notes, the newest first.

    The page marks them in the robot's history, and lists them in Insights. With --keep, the messages before
    the note's time are kept too: `iort incidents` lists them.
    """
    cloud, within = context.obj.cloud(), when.range()
    if text is not None and remove is not None:
        raise UsageError("give a text to write, or --remove")
    if text is None and (at is not None or by is not None or keep is not None):
        raise UsageError("--at, --by and --keep need a text to write")
    if remove is not None:
        stored.remove_note(cloud, robot, remove)
        say(f"note {remove} of {robot} is deleted")
        return
    if text is not None:
        t_us = None if at is None else time_us(at, time.time_ns() // 1000)
        keep_us = 0 if keep is None else duration_us(keep)
        author = user() if by is None else by
        found = [stored.write_note(cloud, robot, text, by=author, t_us=t_us, keep_us=keep_us)]
        if keep is not None:
            say(f"{robot} is to keep {keep} before it: `iort incidents {robot}` tells")
    else:
        registry.get(cloud, robot)
        found = stored.notes(cloud, robot, within.start_us, within.end_us, most=count)
    none = f"no notes about {robot} in this range"
    listing(found, _note_as_json, _show_note, as_json=as_json, none=none)


def _show_note(note: Note) -> None:
    out.print(f"{iso_s(note.t_us)}  {note.id}  {note.by}: {note.text}", soft_wrap=True)


def _note_as_json(note: Note) -> dict[str, object]:
    about = {"id": note.id, "robot": note.robot, **stamped("time", note.t_us)}
    return {**about, "by": note.by, "text": note.text}
