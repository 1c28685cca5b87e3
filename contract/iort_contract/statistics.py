"""Summarises the seconds of a stream from its batches. Pure functions.

In plain Python: the usual event has a batch of one second, and numpy would cost a Lambda function without it
more than the whole event does.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from operator import sub
from statistics import mean, median
from typing import TYPE_CHECKING, Iterable, Iterator, Mapping, Sequence

from iort_contract.catalog.derived import Vehicle, derive
from iort_contract.catalog.vesc import ABSENT_FROM, absent
from iort_contract.codec import Statistics, packed_second
from iort_contract.limits import MAX_BATCH_SPAN_US, Value
from iort_contract.messages.batch import Batch, BatchId, RunEnd
from iort_contract.tables import ABSENT, BATCHES, GAPS, MISSING_BATCHES, NONFINITE, SAMPLES

if TYPE_CHECKING:
    from typing import TypeGuard

# A step this many times the median is a gap: one lost sample makes 2; the jitter of a loaded Jetson reached
# 2.5 on a recorded drive at 50 Hz.
_HOLE = 3.0
_SECOND_US = 1_000_000
# The clocks of a stream's publishers may differ by this much before batches count as missing.
ASIDE_US = 10_000_000
_NUMBERS = {int, float}


def summarize_second(
    second: int, batches: Sequence[Batch], vehicle: Vehicle | None, missing: int = 0
) -> dict[str, Statistics] | None:
    """The summary of one second as stored, or None if it has no samples; ``missing`` batches are known to be
    missing before its own.

    ``batches`` are those of one stream, in order of time: all with a sample in the second, and the one
    before, which shows gaps and missing batches. The result has ``n``, ``batches``, ``missing_batches``,
    ``gaps``, ``nonfinite`` and every field, with the derived fields if fields and vehicle allow
    (`iort_contract.codec`). ``absent`` counts values of sensors that are not fitted,
    which are null here.
    """
    start_us, end_us = second * _SECOND_US, (second + 1) * _SECOND_US
    times: list[int] = []
    columns: dict[str, list[Value]] = {}
    nonfinite = touching = 0
    before: list[int] = []
    for batch in batches:
        first, end = bisect_left(batch.times_us, start_us), bisect_left(batch.times_us, end_us)
        if first < end:
            touching += 1
            for name, column in batch.columns.items():
                columns.setdefault(name, [None] * len(times)).extend(column[first:end])
            times.extend(batch.times_us[first:end])
            for column in columns.values():
                if len(column) < len(times):
                    column.extend([None] * (len(times) - len(column)))
        if start_us <= batch.t_us < end_us:
            nonfinite += batch.nonfinite
        if first:
            before = [batch.times_us[first - 1]]
    if not times:
        return None
    counts: dict[str, Value] = {
        SAMPLES: len(times),
        BATCHES: touching,
        MISSING_BATCHES: missing,
        GAPS: count_holes([*before, *sorted(times)]),
        NONFINITE: nonfinite,
    }
    without, absences = without_absent(columns)
    if absences:
        counts[ABSENT] = sum(absences.values())
    fields = {name: statistics_of(column) for name, column in {**without, **derive(without, vehicle)}.items()}
    return packed_second(counts, {name: known for name, known in fields.items() if known is not None})


def summarize_seconds(
    batches: Iterable[Batch], first: int, end: int, vehicle: Vehicle | None
) -> Iterator[tuple[int, dict[str, Statistics]]]:
    """The seconds from ``first`` until ``end`` that have samples, with their summaries.

    ``batches`` are those of one stream in order of time: all that begin within `reach`, and the one before.
    """
    near: deque[Batch] = deque()
    second = first
    for batch in batches:
        while second < end and batch.t_us > reach(second, second + 1)[1]:
            yield from _summarized(second, near, vehicle)
            second += 1
            while len(near) > 1 and near[1].t_us < reach(second, end)[0]:
                near.popleft()
        near.append(batch)
    for rest in range(second, end):
        yield from _summarized(rest, near, vehicle)


def reach(first: int, end: int) -> tuple[int, int]:
    """The times between which batches begin that decide about seconds, both inclusive."""
    return first * _SECOND_US - ASIDE_US - MAX_BATCH_SPAN_US, end * _SECOND_US + ASIDE_US


def _summarized(
    second: int, near: Iterable[Batch], vehicle: Vehicle | None
) -> Iterator[tuple[int, dict[str, Statistics]]]:
    batches = list(near)
    ids = [batch.id for batch in batches]
    missing = sum(
        missing_before(own, ids, batch.previous)
        for own, batch, before in zip(ids, batches, [None, *ids])
        # Nearly always a batch follows on the one before.
        if own.t_us // _SECOND_US == second and (before is None or before[1:] != (own.boot, own.seq - 1))
    )
    summary = summarize_second(second, batches, vehicle, missing)
    if summary is not None:
        yield second, summary


def without_absent(
    columns: Mapping[str, Sequence[Value]],
) -> tuple[Mapping[str, Sequence[Value]], dict[str, int]]:
    """The columns with None for values of sensors that are not fitted, and the count of those by field."""
    replaced: dict[str, Sequence[Value]] = {}
    absences: dict[str, int] = {}
    for name in columns.keys() & ABSENT_FROM.keys():
        column = columns[name]
        # For nearly every column, its minimum decides.
        if _are_numbers(column) and not (column and absent(name, min(column))):
            continue
        known = [None if absent(name, value) else value for value in column]
        count = sum(value is None for value in known) - sum(value is None for value in column)
        if count:
            replaced[name], absences[name] = known, count
    return ({**columns, **replaced} if replaced else columns), absences


def missing_before(batch: BatchId, near: Sequence[BatchId], previous: Sequence[RunEnd] | None = None) -> int:
    """The number of batches missing just before one, by their sequence numbers.

    ``near`` are the batches around it in order of time, with at least the one before. A batch that names the
    runs before it, in ``previous``, is of a run that numbers from 0; of a named run that is near, the last
    batches may be missing too. Without ``previous``, numbers may go on over a restart; a restart at a lower
    number means that the spool was lost, and only its start is known. If two runs overlap in time, as when a
    recording is played twice, the first batch of such a run counts as complete.
    """
    own = [other.seq for other in near if other.boot == batch.boot and other.seq < batch.seq]
    if own:
        return batch.seq - max(own) - 1
    if previous is not None:
        missing = batch.seq
        for end in previous:
            run = [other for other in near if other.boot == end.boot]
            if run and max(run) < batch:
                missing += max(0, end.seq - max(other.seq for other in run))
        return missing
    before = [other for other in near if other.boot != batch.boot and other < batch]
    if not before:
        return batch.seq
    if any(other.boot == before[-1].boot and other > batch for other in near):
        return 0
    return batch.seq - before[-1].seq - 1 if batch.seq > before[-1].seq else batch.seq


def count_holes(times_us: Sequence[int]) -> int:
    """Steps between samples over three times the median step; at least three steps are needed."""
    steps = list(map(sub, times_us[1:], times_us))
    # Nearly always the least step decides, which the median is not below.
    if len(steps) < 3 or max(steps) <= _HOLE * min(steps):
        return 0
    limit = _HOLE * median(steps)
    return sum(step > limit for step in steps)


def statistics_of(column: Sequence[Value]) -> Statistics:
    """Min, mean, max and last of a numeric column, or one value if all are equal; the last value of any other
    column; None for an empty one."""
    numbers = numbers_of(column)
    if len(numbers) < len(column):
        values = [value for value in column if value is not None]
        if not values or len(numbers) < len(values):
            return values[-1] if values else None
    # In half the time of min and max.
    ordered = sorted(numbers)
    low, high = ordered[0], ordered[-1]
    if low == high:
        return [low]
    # Nine digits are enough for a mean; seventeen would double the table's size.
    rounded = float(f"{_mean(numbers):.9g}")
    return [low, min(max(rounded, low), high), high, numbers[-1]]


def numbers_of(column: Sequence[Value]) -> Sequence[int | float]:
    """The numbers of a column that may hold other values."""
    return column if _are_numbers(column) else [value for value in column if _is_number(value)]


def _mean(numbers: Sequence[int | float]) -> float:
    try:
        return math.fsum(numbers) / len(numbers)
    except OverflowError:  # the sum is over 1.8e308, but the mean never is
        return float(mean(numbers))


def _are_numbers(column: Sequence[Value]) -> TypeGuard[Sequence[int | float]]:
    """Whether all values are numbers, by their types, as in nearly every column."""
    return set(map(type, column)) <= _NUMBERS


def _is_number(value: Value) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
