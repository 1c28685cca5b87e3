"""Computes a topic's seconds from the telemetry table.

The input is the table, not the records: in any order, number or grouping of records, the last one of a second
leaves the same item.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from functions.shared.summary.stored import Reader, Stored
from functions.shared.tables import Tables
from iort_contract.codec.seconds import Statistics
from iort_contract.limits import MAX_BATCH_SPAN_US
from iort_contract.messages.batch import Batch, BatchId
from iort_contract.statistics import summarize_second
from iort_contract.tables import EXPIRES_S
from iort_contract.topics import parse_topic

_SECOND_US = 1_000_000
# Seconds closer than this are read together, since a query costs as much as the batches between them. The
# number is limited, since they are held in memory.
_NEAR_S, _READ_TOGETHER_S = 10, 60


@dataclass
class Summaries:
    """A topic's summary by second, the batches missing just before the event's batches, and the event's
    batches beyond their second's limit."""

    seconds: dict[int, dict[str, Statistics]] = field(default_factory=dict)
    missing: int = 0
    beyond: set[BatchId] = field(default_factory=set)


def _never() -> None:
    """A check that always passes."""


def summarize_topic(
    tables: Tables, topic: str, batches: Sequence[Batch], check: Callable[[], None] = _never
) -> Summaries:
    """The summaries of every second that the batches touch, and of the second of the batch after each: a late
    batch fills the gap that its successor reported. ``check`` is called regularly and may raise."""
    known = {batch.id: batch for batch in batches}
    reader = Reader(tables, topic, known, check)
    vehicle = tables.vehicle(parse_topic(topic).robot)
    summaries = Summaries()
    within: set[BatchId] = set()
    runs = _runs({second for batch in batches for second in _seconds(batch)})
    while runs:
        run = runs.pop(0)
        stored, last = reader.read(run[0], run[-1])
        touched, later = [s for s in run if s <= last], [s for s in run if s > last]
        if later:
            runs.insert(0, later)
        seconds = set(touched)
        previous: Batch | None = None
        missing: dict[int, int] = defaultdict(int)
        for batch, _, _, beyond in stored:
            second = batch.t_us // _SECOND_US
            # The seconds before and after a range are read in part, and belong to another range.
            if previous is not None and previous.id in known and second >= touched[0]:
                seconds.add(second)
            if second in seconds:
                lacking = reader.missing_before(batch, previous, stored)
                missing[second] += lacking
                if batch.id in known and not beyond and second <= touched[-1]:
                    within.add(batch.id)
                    summaries.missing += lacking
            previous = batch
        for second in seconds:
            check()
            near = around(stored, second)
            batches_near = [entry.batch for entry in near]
            summary = summarize_second(second, batches_near, vehicle, missing[second])
            if summary is None:
                continue
            # A second expires with its batches, by their time of receipt: the samples' own time may be years
            # off, in a replayed drive or under a car's wrong clock.
            if expires := [entry.expires_s for entry in near if entry.expires_s]:
                summary[EXPIRES_S] = max(expires)
            summaries.seconds[second] = summary
    summaries.beyond = {key for key in known if key.t_us // _SECOND_US in reader.full} - within
    return summaries


def around(stored: Sequence[Stored], second: int) -> Sequence[Stored]:
    """From batches in order of time, those with samples in the second and the one before. It leaves out
    batches beyond the second's own limit."""
    start_us, end_us = second * _SECOND_US, (second + 1) * _SECOND_US
    first = bisect_left(stored, start_us - MAX_BATCH_SPAN_US, key=_start)
    end = bisect_left(stored, end_us, lo=first, key=_start)
    inside = [i for i in range(first, end) if stored[i].batch.times_us[-1] >= start_us]
    near = stored[max(0, inside[0] - 1) : inside[-1] + 1] if inside else []
    return [entry for entry in near if not (entry.beyond and entry.batch.t_us >= start_us)]


def _seconds(batch: Batch) -> range:
    return range(batch.times_us[0] // _SECOND_US, batch.times_us[-1] // _SECOND_US + 1)


def _start(entry: Stored) -> int:
    return entry.batch.t_us


def _runs(seconds: set[int]) -> list[list[int]]:
    """The seconds in order, grouped into ranges: a car whose clock jumped touches 1970 and today."""
    runs: list[list[int]] = []
    for second in sorted(seconds):
        if not runs or second - runs[-1][-1] > _NEAR_S or second - runs[-1][0] >= _READ_TOGETHER_S:
            runs.append([])
        runs[-1].append(second)
    return runs
