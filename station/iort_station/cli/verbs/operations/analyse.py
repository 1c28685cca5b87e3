"""`iort analyse`: start a run of the analysis."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from datetime import timedelta
from typing import Annotated

import typer

from iort_analysis.drives.finding import LONGEST_US
from iort_contract.catalog.analysis import ANALYSIS_FAILED
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.limits import MAX_AHEAD_US, ContractError
from iort_contract.messages.analysis import AnalysisRequest, decode_request, encode_request
from iort_station.cli import completion
from iort_station.cli.console import errors, tell
from iort_station.cli.options import AsJson, When, ranged
from iort_station.cli.words import examples, say
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.times import iso_s

commands = typer.Typer()
# The range without an option.
_USUAL = "1d"


@commands.command("analyse", epilog=examples("analyse car7 --last 1d", "analyse --fleet --last 7d --wait"))
@ranged
def analyse(
    context: typer.Context,
    when: When,
    robots: Annotated[
        list[str] | None,
        typer.Argument(help="The robots.", autocompletion=completion.robots, show_default=False),
    ] = None,
    fleet: Annotated[bool, typer.Option("--fleet", help="Every registered robot.")] = False,
    new: Annotated[bool, typer.Option("--new", help="Only drives that have not been analysed.")] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait for the findings, and show how far it is.")
    ] = False,
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
        for finding in findings.findings(cloud, robot, from_us, request.end_us)
        if finding.kind == ANALYSIS_FAILED and finding.to_us >= request.start_us
    ]
    facts = {"run": name, "drives": done.drives or 0, "failed": len(failed), "findings": done.findings}
    text = f"drives analysed: {done.drives or 0}, findings: {done.findings}"
    if not done.drives:
        for line in _recorded(cloud, robots or sorted(findings.robots_of(cloud, None)), request):
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
