"""The seconds of a stream from its batches: what `iort_contract.statistics` says of each second, for hours at
a time by numpy."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.batches import Item, Wanted
from iort_analysis.samples.blocks import Block, Column, column_of, join, values
from iort_contract.catalog.vesc import ABSENT_FROM, absent
from iort_contract.dynamodb import plain
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError, Value
from iort_contract.messages.batch import Batch, BatchId, RunEnd, decode_batch
from iort_contract.statistics import ASIDE_US, count_holes, missing_before, statistics_of
from iort_contract.tables import ABSENT, BATCHES, GAPS, MISSING_BATCHES, NONFINITE, SAMPLES, STATS

_SECOND_US = 1_000_000
# A second is final once the batches so long after it are there.
_AFTER_S = ASIDE_US // _SECOND_US + 1
Derive = Callable[[Mapping[str, Column]], Mapping[str, Column]]


@dataclass(frozen=True)
class Batches:
    """Batches of a stream in the order of their ids, with all samples in the same order. ``rows`` are the
    first sample of each batch, and the end."""

    ids: Sequence[BatchId]
    nonfinite: Sequence[int]
    previous: Sequence[tuple[RunEnd, ...] | None]
    rows: NDArray[np.int64]
    samples: Block

    def since(self, t_us: int) -> Batches:
        """The batches from a time on, and the one before them."""
        first = max(0, bisect_left(self.ids, t_us, key=lambda one: one.t_us) - 1)
        row = int(self.rows[first])
        return Batches(
            self.ids[first:],
            self.nonfinite[first:],
            self.previous[first:],
            self.rows[first:] - row,
            self.samples.take(slice(row, None)),
        )


def batches_of(items: Iterable[Item], wanted: Wanted = lambda _name: True) -> Batches:
    """Stored items as batches; what is not a batch is left out."""
    found: list[Batch] = []
    for item in items:
        with suppress(ContractError):
            found.append(decode_batch(plain(item)))
    blocks = (
        Block(
            np.array(one.times_us, dtype=np.int64),
            {name: column_of(column) for name, column in one.columns.items() if wanted(name)},
        )
        for one in found
    )
    return Batches(
        [one.id for one in found],
        [one.nonfinite for one in found],
        [one.previous for one in found],
        np.cumsum([0, *(len(one.times_us) for one in found)]),
        join(list(blocks)),
    )


NONE = Batches((), (), (), np.zeros(1, dtype=np.int64), join([]))


def joined_batches(one: Batches, other: Batches) -> Batches:
    """The batches of both; the second ones come later."""
    return Batches(
        [*one.ids, *other.ids],
        [*one.nonfinite, *other.nonfinite],
        [*one.previous, *other.previous],
        np.concatenate([one.rows, one.rows[-1] + other.rows[1:]]),
        join([one.samples, other.samples]),
    )


def summarized(parts: Iterator[Batches], first: int, end: int, derive: Derive) -> Iterator[Block]:
    """The seconds from ``first`` until ``end`` that have samples, flat as `iort_contract.codec` says.

    ``parts`` are all batches from `reach` on, and the one before them; ``derive`` makes the derived fields.
    """
    held = NONE
    for part in parts:
        held = joined_batches(held, part)
        final = min(end, held.ids[-1].t_us // _SECOND_US - _AFTER_S) if held.ids else first
        if final > first:
            yield from _seconds(held, first, final, derive)
            first = final
            held = held.since(reach(final, final)[0])
    yield from _seconds(held, first, end, derive)


def reach(first: int, end: int) -> tuple[int, int]:
    """The times between which batches start that decide about seconds, both inclusive."""
    start_us, end_us = first * _SECOND_US, end * _SECOND_US
    return start_us - ASIDE_US - MAX_BATCH_SPAN_US, end_us + ASIDE_US


def _seconds(batches: Batches, first: int, end: int, derive: Derive) -> Iterator[Block]:
    second_of = batches.samples.times_us // _SECOND_US
    chosen = np.flatnonzero((second_of >= first) & (second_of < end))
    if not len(chosen):
        return
    # Within a second the samples stay in the order of their batches.
    chosen = chosen[np.argsort(second_of[chosen], kind="stable")]
    own = second_of[chosen]
    starts = np.flatnonzero(np.append(True, own[1:] != own[:-1]))
    seconds = own[starts]
    columns = {name: column[chosen] for name, column in batches.samples.columns.items()}
    absences = np.zeros(len(seconds))
    for name in columns.keys() & ABSENT_FROM.keys():
        mask = absent_values(name, columns[name])
        if mask.any():
            columns[name][mask] = np.nan if columns[name].dtype.kind == "f" else None
            absences += np.add.reduceat(mask.astype(float), starts)
    columns |= derive(columns)
    of_batch = np.repeat(np.arange(len(batches.ids)), np.diff(batches.rows))[chosen]
    changes = np.append(True, of_batch[1:] != of_batch[:-1])
    changes[starts] = True
    missing, nonfinite = _of_starts(batches, seconds)
    counts: dict[str, Column] = {
        SAMPLES: np.diff(np.append(starts, len(chosen))).astype(float),
        BATCHES: np.add.reduceat(changes.astype(float), starts),
        MISSING_BATCHES: missing,
        GAPS: _gaps(batches, seconds, batches.samples.times_us[chosen], starts),
        NONFINITE: nonfinite,
    }
    if absences.any():
        counts[ABSENT] = np.where(absences > 0, absences, np.nan)
    found: dict[str, Column] = {}
    for name, column in columns.items():
        made = _statistics(column, starts) if column.dtype.kind == "f" else _odd_statistics(column, starts)
        found |= {f"{name}_{statistic}": each for statistic, each in made.items()}
    yield Block(seconds * _SECOND_US, counts | found)


def absent_values(name: str, column: Column) -> NDArray[np.bool_]:
    """Which values of a field stand for a sensor that is not fitted."""
    if column.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            return np.asarray(column <= ABSENT_FROM[name])
    return np.array([absent(name, value) for value in column.tolist()], dtype=np.bool_)


def _of_starts(batches: Batches, seconds: NDArray[np.int64]) -> tuple[Column, Column]:
    """For each second the batches missing before those that start in it, and their values that were not
    finite."""
    missing, nonfinite = np.zeros(len(seconds)), np.zeros(len(seconds))
    place = {second: i for i, second in enumerate(seconds.tolist())}
    ids = batches.ids
    for number, one in enumerate(ids):
        at = place.get(one.t_us // _SECOND_US)
        if at is None:
            continue
        nonfinite[at] += batches.nonfinite[number]
        if number and ids[number - 1][1:] == (one.boot, one.seq - 1):
            continue
        start_us = one.t_us // _SECOND_US * _SECOND_US
        near = _between(ids, start_us - ASIDE_US, start_us + _SECOND_US + ASIDE_US)
        around = ids[min(near.start, max(0, number - 1)) : near.stop]
        missing[at] += missing_before(one, around, batches.previous[number])
    return missing, nonfinite


def _between(ids: Sequence[BatchId], first_us: int, end_us: int) -> range:
    first = bisect_left(ids, first_us, key=lambda one: one.t_us)
    return range(first, bisect_left(ids, end_us, lo=first, key=lambda one: one.t_us))


def _gaps(
    batches: Batches, seconds: NDArray[np.int64], times_us: NDArray[np.int64], starts: NDArray[np.intp]
) -> Column:
    """The gaps between samples of each second, and from the sample before it."""
    all_us, rows = batches.samples.times_us, batches.rows
    last_us = all_us[rows[1:] - 1]
    found = []
    parts = pairwise([*starts.tolist(), len(times_us)])
    for second, (start, end) in zip(seconds.tolist(), parts, strict=True):
        start_us = second * _SECOND_US
        near = _between(batches.ids, start_us - MAX_BATCH_SPAN_US, start_us + _SECOND_US)
        inside = [i for i in near if last_us[i] >= start_us]
        before: list[int] = []
        for i in range(inside[-1], max(0, inside[0] - 1) - 1, -1):
            if batches.ids[i].t_us < start_us:
                own = all_us[rows[i] : rows[i + 1]]
                before = [int(own[np.searchsorted(own, start_us) - 1])]
                break
        found.append(count_holes([*before, *np.sort(times_us[start:end]).tolist()]))
    return np.array(found, dtype=float)


def _statistics(column: Column, starts: NDArray[np.intp]) -> dict[str, Column]:
    """The statistics of numbers."""
    known = ~np.isnan(column)
    count = np.add.reduceat(known.astype(float), starts)
    if not count.any():
        return {}
    low, high = np.fmin.reduceat(column, starts), np.fmax.reduceat(column, starts)
    # The sum of some large numbers is beyond a float64, and their mean is not.
    total = np.add.reduceat(np.where(known, column, 0).astype(np.longdouble), starts)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (total / count).astype(float)
    rounded = np.array([float(f"{value:.9g}") for value in mean.tolist()])
    last = np.maximum.reduceat(np.where(known, np.arange(len(column)), -1), starts)
    made = low, np.clip(rounded, low, high), high, np.where(count > 0, column[last], np.nan)
    return dict(zip(STATS, made, strict=True))


def _odd_statistics(column: Column, starts: NDArray[np.intp]) -> dict[str, Column]:
    """The statistics of flags, of texts, or of values of several kinds."""
    rows: list[dict[str, Any]] = []
    told: list[Value] = values(column)
    for start, end in pairwise([*starts.tolist(), len(told)]):
        found = statistics_of(told[start:end])
        if isinstance(found, list):
            four = found * len(STATS) if len(found) == 1 else found
            rows.append(dict(zip(STATS, map(_as_float, four), strict=True)))
        else:
            rows.append({} if found is None else {STATS[-1]: _as_float(found)})
    names = [name for name in STATS if any(name in row for row in rows)]
    return {name: column_of([row.get(name) for row in rows]) for name in names}


def _as_float(value: Value) -> Value:
    return float(value) if type(value) is int else value
