"""`iort audit`: proof of delivery."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.table import Table
from rich.text import Text

from iort_contract.limits import ContractError
from iort_contract.tables import ROBOT
from iort_contract.topics import check_robot, check_stream
from iort_station.cli import options
from iort_station.cli.console import Lines, errors, out, print_json
from iort_station.cli.options import AsJson, Range, When, argument, examples, option, ranged, say_archived
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.times import between_hours, duration_us, iso, iso_s, stamped

if TYPE_CHECKING:
    from iort_contract.messages.page import Archived
    from iort_station.cloud import Cloud
    from iort_station.operations.audit import Audit, RunAudit

commands = typer.Typer()
# How many gaps of a run are listed one by one.
_LISTED = 20


@commands.command("audit", epilog=examples("audit car7 --last 1h", "audit --all"))
@ranged
def audit_(
    context: typer.Context,
    when: When,
    robot: Annotated[str | None, argument("The robot's name.", autocompletion=options.robots)] = None,
    every: Annotated[bool, option("Every registered robot.", "--all")] = False,
    streams: Annotated[
        list[str] | None,
        option(
            "Only this stream; may be repeated. Default: all known.",
            "--stream",
            autocompletion=options.streams,
        ),
    ] = None,
    late: Annotated[str, option("Count a batch as late if it took so much longer than the fastest.")] = "5s",
    from_start: Annotated[
        bool, option("Count batches before the first stored one as missing.", "--from-start")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Prove that every sample of a robot arrived, for each of its streams and each run of its agent.

    The command decodes every batch and checks their sequence numbers. It compares the stored samples with
    those that the agent counted, and lists by cause what the agent did not record. Exit status 0 if every
    stream is complete and the agent left nothing out; 1 otherwise, or if nothing is stored.
    """
    if (robot is None) != every:
        raise UsageError("give a robot, or --all")
    within, late_us = when.range(), duration_us(late)
    cloud = context.obj.cloud()
    names = [robot] if robot else sorted(str(row[ROBOT]) for row in registry.listed(cloud))
    audited: dict[str, _Audited] = {}
    for name in names:
        audited[name] = _audit(cloud, name, within, streams, late_us, from_start=from_start)
        if not as_json:
            if every:
                out.print(Text(name, "bold"))
            _print(name, audited[name])
    if as_json:
        told = {name: each.as_json() for name, each in audited.items()}
        print_json({"robots": told} if every else told[names[0]])
    # A robot that never recorded has lost nothing, but is no proof of anything either.
    judged = [each for each in audited.values() if each.streams or not every]
    complete = sum(each.complete for each in judged)
    if every and not as_json:
        out.print(f"complete: {complete} of {len(judged)} robots with recordings")
    raise typer.Exit(0 if judged and complete == len(judged) else 1)


class _Audited(NamedTuple):
    """A robot's streams, what its agent did not record by run and cause, and the hours of its archive."""

    streams: list[Audit]
    causes: dict[str, Any]
    archive: Archived | None

    @property
    def complete(self) -> bool:
        return bool(self.streams) and not self.causes and all(one.complete for one in self.streams)

    def as_json(self) -> dict[str, Any]:
        return {
            "streams": list(map(_as_json, self.streams)),
            "not_recorded": self.causes,
            "archive": self.archive and between_hours(self.archive),
        }


def _audit(
    cloud: Cloud,
    robot: str,
    within: Range,
    streams: list[str] | None,
    late_us: int,
    *,
    from_start: bool,
) -> _Audited:
    # numpy takes longer to load than TAB may take.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_analysis.samples.batches import RefusedItems  # noqa: PLC0415 - as above
    from iort_station.data import inventory  # noqa: PLC0415 - see above
    from iort_station.data.accounts import accounts  # noqa: PLC0415 - as above
    from iort_station.operations import audit  # noqa: PLC0415 - as above

    try:
        check_robot(robot)
        names = [check_stream(name) for name in streams or ()] or inventory.known(cloud, robot)
    except ContractError as error:
        raise UsageError(str(error)) from error
    figures = audit.last_figures(cloud, robot)
    audits: list[Audit] = []
    archived, now_us = Origin(), time.time_ns() // 1000
    told = accounts(cloud, robot)
    with errors.status("reading") as status:
        for name in names:
            origin, refused = Origin(), RefusedItems()
            headers = audit.headers(
                cloud, robot, name, within.start_us, within.end_us, origin=origin, refused=refused
            )
            counted = _counting(headers, name, status)
            one = audit.audit(name, counted, late_ms=late_us // 1000, from_start=from_start)
            one = audit.without_lateness(one, told)
            one = replace(one, refused=refused.count, named=tuple(refused.named))
            # The agent counts a whole run, so a part of one cannot be compared.
            if within == Range(None, None):
                one = audit.held_against(one, told, now_us)
            if one.runs or one.refused or one.taken is not None or streams:
                audits.append(one)
                archived.hours += origin.within(within.start_us, within.end_us).hours
    waiting, dropped = (figures.get(name) for name in ("backlog_batches", "dropped_batches"))
    in_car = audit.in_car(None if waiting is None else int(waiting), audits, told)
    dropped = None if dropped is None else int(dropped)
    audits = [replace(one, in_car=in_car, dropped=dropped) for one in audits]
    causes = {} if streams else {boot: run.not_recorded() for boot, run in told.items() if run.not_recorded()}
    for one in audits if streams else ():
        if not (one.runs or one.refused or one.taken):
            inventory.check_there(cloud, robot, one.stream)
    if not audits:
        inventory.check_recorded(cloud, robot)
    return _Audited(audits, causes, archived.told())


def _print(robot: str, audited: _Audited) -> None:
    if not audited.streams:
        errors.print(f"this range holds nothing of {robot}")
    for one in audited.streams:
        _show(one)
    for boot, sources in audited.causes.items() if audited.streams else ():
        for source, counts in sources.items():
            out.print(f"run {boot[:8]}, {source}: not recorded", style="red")
            for cause, count in counts.items():
                out.print(f"  {count:,} {cause}")
    say_archived(audited.archive)


def _counting(items: Any, name: str, status: Any) -> Any:
    for count, item in enumerate(items, 1):
        if not count % 1000:
            status.update(f"{name}: {count:,} batches")
        yield item


def _show(one: Audit) -> None:
    if not one.runs:
        out.print(Text.assemble(f"{one.stream}: ", ("nothing stored in this range", "bold red")))
    else:
        out.print(Text.assemble(f"{one.stream}: ", *_said(one)))
        out.print(_table(one))
    for run in one.runs:
        for gap in run.missing[:_LISTED]:
            after = "the start" if gap.after_us is None else iso(gap.after_us)
            before = "the end" if gap.before_us is None else iso(gap.before_us)
            out.print(f"  missing {gap.first:,} to {gap.last:,}: between {after} and {before}")
        if len(run.missing) > _LISTED:
            out.print(f"  and {len(run.missing) - _LISTED} more gaps; --json prints all")
    for lost in one.lost_runs:
        out.print(f"  run {lost.boot[:8]}: none of its {lost.batches:,} batches is stored", style="red")
    if one.before_first:
        out.print(
            f"  the first stored number is {one.before_first:,}: before it is expired, out of range or lost"
        )
    for boot, samples, cause in one.shortfalls:
        count = "an unknown number of samples" if samples is None else f"{samples:,} samples"
        out.print(f"  run {boot[:8]}: {count} {cause}", style="red")
    if one.refused:
        out.print(f"  {one.refused:,} stored items cannot be read", style="red")
        for named in one.named:
            out.print(f"    {named}", style="red", soft_wrap=True)
    if one.in_car:
        out.print(f"  the car's queue held {one.in_car:,} batches at its last report")
    if one.dropped:
        out.print(
            f"  the car has dropped {one.dropped:,} batches: its queue was full, or damaged", style="red"
        )


def _said(one: Audit) -> tuple[tuple[str, str], str]:
    """The verdict with its style, and what the agent counted."""
    told = "" if one.taken is None else f" ({one.taken:,} samples taken by the agent, at its last report)"
    if one.complete:
        return ("complete", "green"), told
    what = f"{one.missing:,} batches missing" if one.missing else "not complete"
    return (what, "bold red"), told


def _table(one: Audit) -> Table:
    """A row for each run, in 80 columns: first above last, and how late the latest batch was below their
    number."""
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for i, name in enumerate(
        ("run", "from, to", "numbers", "expected", "stored", "missing", "twice", "late", "samples")
    ):
        table.add_column(name, justify="right" if i > 1 else "left")
    for run in one.runs:
        missing = sum(gap.batches for gap in run.missing)
        table.add_row(
            run.boot[:8],
            Lines(f"{iso_s(run.first_us)}\n{iso_s(run.last_us)}"),
            Lines(f"{run.first_seq:,}\n{run.last_seq:,}"),
            f"{run.expected:,}",
            f"{run.batches:,}",
            f"{missing:,}",
            f"{run.duplicated:,}",
            _late(run),
            f"{run.samples:,}",
            style="red" if missing else "",
        )
    return table


def _late(run: RunAudit) -> Lines:
    if run.late is None or run.latest_ms is None:
        return Lines("-")
    return Lines(f"{run.late:,}" + (f"\n{run.latest_ms / 1000:.1f} s" if run.late else ""))


def _as_json(audit: Audit) -> dict[str, Any]:
    """With each run's times and gaps as JSON has them, and what follows from the counts."""
    runs = []
    for run in audit.runs:
        facts = asdict(run)
        for name in ("samples_of", "first_us", "last_us"):
            del facts[name]
        gaps = [
            {
                "first": gap.first,
                "last": gap.last,
                **stamped("after", gap.after_us),
                **stamped("before", gap.before_us),
            }
            for gap in run.missing
        ]
        times = stamped("first", run.first_us) | stamped("last", run.last_us)
        counts = {"expected": run.expected, "missing_batches": sum(gap.batches for gap in run.missing)}
        runs.append(facts | times | counts | {"missing": gaps})
    shortfalls = [short._asdict() for short in audit.shortfalls]
    verdict = {"missing": audit.missing, "complete": audit.complete}
    return {**asdict(audit), "runs": runs, "shortfalls": shortfalls, **verdict}
