"""The audit's word about a range of a stream: complete, incomplete or unknown, and why.

The range's batches are held against their neighbours outside it, which tell whether numbers are missing at
its edges, and against the accounts of the runs, which tell what followed a run's last batch.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeAlias

from iort_analysis.samples.batches import RefusedItems
from iort_contract.dynamodb import starting_between
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S
from iort_contract.messages.batch import batch_id, run_ends
from iort_contract.tables import BATCH, PREVIOUS
from iort_station.cloud import Cloud
from iort_station.data.accounts import SILENT_US, Account
from iort_station.data.recorded import Recorded
from iort_station.data.runs import Report, reports
from iort_station.operations.audit import NOT_ENDED, Audit, RunAudit, audit, headers, shortfalls
from iort_station.times import iso

Word: TypeAlias = Literal["complete", "incomplete", "unknown"]
# Publishers whose batches interleave each have one within this time.
_BESIDE_US = 2 * MAX_BATCH_SPAN_US
# A run's last report comes this long after its last batch at most.
_REPORT_US = round(2e6 * ACCOUNT_EVERY_S)
_ENDLESS_US = 2**62


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the audit says of a stream from ``start_us`` (inclusive) to ``end_us`` (exclusive), both
    microseconds since the epoch; None is open.

    ``word`` is "complete" if everything that the robot recorded there is stored, "incomplete" if something is
    known to be missing or unreadable, and "unknown" if nobody can tell yet; ``why`` gives the reasons, and is
    empty if complete. ``batches`` counts the stored ones that begin there, ``missing`` the batch numbers
    that are not stored.
    """

    robot: str
    stream: str
    start_us: int | None
    end_us: int | None
    word: Word
    why: tuple[str, ...]
    batches: int
    missing: int


class _Reason(NamedTuple):
    """Why a range is not complete; ``known`` if something is missing for sure."""

    known: bool
    text: str
    missing: int = 0


class _TooManyError(Exception):
    pass


def verdict(
    cloud: Cloud,
    robot: str,
    stream: str,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    refused: tuple[int, str] | None = None,
    most: int | None = None,
) -> Verdict:
    """The audit's word about a range. ``refused`` is what a reader of its samples could not read: how many
    items, and the first; None has every batch of the table decoded here. At more than ``most`` batches
    nothing is compared, and the word is "unknown"."""
    recorded = Recorded(cloud, robot, stream)
    # A batch that began before the range may reach into it.
    low_us = None if start_us is None else start_us - MAX_BATCH_SPAN_US
    before = None if low_us is None else recorded.before(low_us)
    after = None if end_us is None else recorded.after(end_us)
    first_us = None if before is None else before.t_us - _BESIDE_US
    last_us = None if after is None else after.t_us + _BESIDE_US
    low, high = start_us or 0, _ENDLESS_US if end_us is None else end_us
    batches, bad = 0, RefusedItems()
    if refused is None:
        items: Iterator[Mapping[str, Any]] = headers(cloud, robot, stream, first_us, last_us, refused=bad)
    else:
        items = _headers(recorded, first_us, last_us)

    earlier: set[str] = set()

    def counted() -> Iterator[Mapping[str, Any]]:
        nonlocal batches
        for number, item in enumerate(items):
            if number == most:
                raise _TooManyError
            with suppress(ContractError):
                batches += low <= batch_id(item.get(BATCH)).t_us < high
                earlier.update(end.boot for end in run_ends(item.get(PREVIOUS, "")))
            yield item

    about: dict[str, Any] = {"robot": robot, "stream": stream, "start_us": start_us, "end_us": end_us}
    try:
        found = audit(stream, counted())
    except _TooManyError:
        why = (f"the range has more than {most:,} batches: `iort audit` reads any number",)
        return Verdict(**about, word="unknown", why=why, batches=batches, missing=0)
    runs = found.runs
    told = reports(cloud, robot, first_us, None if last_us is None else last_us + _REPORT_US)
    accounts = {boot: report.account for boot, report in told.items()}
    reasons = [
        *_gaps(found, low, high),
        *_tails(runs, stream, accounts, low, high),
        *_unseen(found, recorded, told, low, high),
    ]
    if not runs:
        reasons.append(_Reason(known=False, text=f"nothing of {robot} {stream} is stored"))
    elif before is None:
        oldest = min(runs, key=lambda run: run.first_us)
        text, stored = "", {run.boot for run in runs}
        if oldest.first_seq > 0:
            text = f"the first stored batch is number {oldest.first_seq:,} of its run"
        elif low < oldest.first_us and earlier - stored - {lost.boot for lost in found.lost_runs}:
            text = "the first stored run names runs before it"
        if text:
            reasons.append(_Reason(known=False, text=f"{text}: what was before is expired or lost"))
    unread, named = refused or (bad.count, bad.reason)
    if unread := max(unread, found.refused):
        text = f"{unread:,} stored items cannot be read" + (f"; the first: {named}" if named else "")
        reasons.append(_Reason(known=True, text=text))
    word: Word = "complete"
    if reasons:
        word = "incomplete" if any(one.known for one in reasons) else "unknown"
    return Verdict(
        **about,
        word=word,
        why=tuple(dict.fromkeys(one.text for one in reasons)),
        batches=batches,
        missing=sum(one.missing for one in reasons),
    )


def overlap(cloud: Cloud, robot: str, stream: str, start_us: int, end_us: int) -> bool:
    """Whether runs recorded a stream at the same time in a range, as after a clock was set back."""
    found = audit(stream, _headers(Recorded(cloud, robot, stream), start_us - MAX_BATCH_SPAN_US, end_us))
    spans = sorted((run.first_us, run.last_us) for run in found.runs)
    return any(one[1] >= after[0] for one, after in pairwise(spans))


def _headers(recorded: Recorded, first_us: int | None, last_us: int | None) -> Iterator[Mapping[str, Any]]:
    # Strings and numbers only, so no deserializer is needed.
    for item in recorded.headers(starting_between(first_us, last_us)):
        yield {name: next(iter(value.values())) for name, value in item.items()}


def _untils(runs: Sequence[RunAudit]) -> Iterator[tuple[RunAudit, int]]:
    """The runs, each with the time at which the next one begins after its last batch: one that began before
    that had a clock that was set back."""
    starts = [*sorted(run.first_us for run in runs), _ENDLESS_US]
    for run in runs:
        yield run, starts[bisect_right(starts, run.last_us)]


def _gaps(found: Audit, low_us: int, high_us: int) -> Iterator[_Reason]:
    """The numbers that are missing for sure in the range."""
    for run, until_us in _untils(found.runs):
        for gap in run.missing:
            after_us, before_us = gap.after_us or 0, gap.before_us or until_us
            if after_us < high_us and before_us > low_us:
                where = f"after {iso(after_us)}" if gap.after_us else f"before {iso(before_us)}"
                text = f"batches {gap.first:,} to {gap.last:,} of run {run.boot[:8]} are not stored, {where}"
                yield _Reason(known=True, text=text, missing=gap.batches)
    for lost in found.lost_runs:
        text = f"none of the {lost.batches:,} batches of run {lost.boot[:8]} is stored"
        yield _Reason(known=True, text=text, missing=lost.batches)


def _unseen(
    found: Audit, recorded: Recorded, told: Mapping[str, Report], low_us: int, high_us: int
) -> Iterator[_Reason]:
    """The runs that report batches of the stream in the range, and of which no batch was found."""
    seen = {run.boot for run in found.runs} | {lost.boot for lost in found.lost_runs}
    for boot, (part, account) in told.items():
        stated = account.streams.get(found.stream)
        if boot in seen or stated is None or not stated.next_seq:
            continue
        # It began after the runs before it, and at most one report's time before its first report.
        earlier = [run.last_us for run in found.runs if run.last_us < part.first.t_us]
        first_us = max([part.first.t_us - _REPORT_US, *earlier])
        if first_us >= high_us or part.to_us <= low_us:
            continue
        name, n = f"run {boot[:8]}", stated.next_seq
        # Its reports are numbered, so the last one tells how far back it may have begun.
        keys = starting_between(part.last.t_us - (part.last.seq + 1) * _REPORT_US, part.to_us)
        if any(_is_of(boot, item) for item in recorded.headers(keys)):
            yield _Reason(
                known=False, text=f"{name} recorded at the same time as another, and is not compared"
            )
        elif stated.replayed:
            text = f"none of the {n:,} batches of {name} was found, which played a recording of another time"
            yield _Reason(known=False, text=text)
        elif not stated.ended and time.time() * 1e6 - account.received_us < SILENT_US:
            yield _Reason(known=False, text=f"{name} goes on: the robot may hold its {n:,} batches")
        else:
            yield _Reason(known=True, text=f"none of the {n:,} batches of {name} is stored", missing=n)


def _is_of(boot: str, item: Mapping[str, Any]) -> bool:
    with suppress(ContractError):
        return batch_id(item.get(BATCH, {}).get("S")).boot == boot
    return False


def _tails(
    runs: Sequence[RunAudit], stream: str, told: Mapping[str, Account], low_us: int, high_us: int
) -> Iterator[_Reason]:
    """What may have followed the last stored batch of each run that is in the range."""
    for run, until_us in _untils(runs):
        account = told.get(run.boot)
        stated = None if account is None else account.streams.get(stream)
        name = f"run {run.boot[:8]}"
        if account is not None and run.first_us < high_us and run.last_us >= low_us:
            for source, counts in account.not_recorded().items():
                causes = ", ".join(f"{count:,} {cause}" for cause, count in counts.items())
                text = f"{name} did not record all of {source}, at times that are not known: {causes}"
                yield _Reason(known=False, text=text)
        if run.last_us >= high_us or max(until_us, run.last_us) <= low_us:
            continue
        if account is None or stated is None:
            text = f"{name} has no account of {stream}: what followed its last batch is not known"
            yield _Reason(known=False, text=text)
            continue
        running = not stated.ended and time.time() * 1e6 - account.received_us < SILENT_US
        lacking = stated.next_seq - 1 - run.last_seq
        if running:
            yield _Reason(known=False, text=f"{name} goes on: the robot may hold batches that come later")
        elif lacking > 0 and not any(gap.last >= stated.next_seq - 1 for gap in run.missing):
            text = f"batches {run.last_seq + 1:,} to {stated.next_seq - 1:,} of {name} are not stored"
            yield _Reason(known=True, text=text, missing=lacking)
        if not stated.ended and not running:
            text = f"{name}: an unknown number of samples {NOT_ENDED[stated.durable]}"
            yield _Reason(known=False, text=text)
        # The agent counts a whole run, so a part of one cannot be compared.
        if run.first_seq <= stated.first_seq and run.first_us >= low_us and not running:
            for lost in shortfalls(run.boot, stated, run, running=False):
                if lost.samples is not None:
                    yield _Reason(known=True, text=f"{name}: {lost.samples:,} samples {lost.cause}")
