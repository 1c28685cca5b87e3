"""Computes a topic's seconds from the telemetry table.

The input is the table, not the records: in any order, number or grouping of records, the last one of a second
leaves the same item.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

from functions.shared.tables import Tables
from iort_contract.codec import Statistics
from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_COLUMNS_BYTES, ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id, decode_item
from iort_contract.statistics import ASIDE_US, missing_before, summarize_second
from iort_contract.tables import BATCH, EXPIRES_S
from iort_contract.topics import parse_topic

_SECOND_US = 1_000_000
# The limits of batches and column bytes per second and stream: a robot beyond them must not delay others. AWS
# takes as many messages a second from a connection.
SECOND_BATCHES, _SECOND_BYTES = 100, MAX_COLUMNS_BYTES
# Seconds are read together until they are as much as one may be.
_TOGETHER_BYTES = _SECOND_BYTES
# The number of a second's neighbours to read: as many as the seconds beside it may hold.
_NUMBERS = SECOND_BATCHES * (2 * ASIDE_US // _SECOND_US + 1)
# Beside those of the event: the one before, the one after, and the one that shows that its second is whole.
_BESIDE = 3
# An undecodable neighbour is skipped; this many of them end the search.
_NEIGHBOURS = 10


# A stream's last two decoded batches with their items, unless they are large: the next event needs one of
# them as the one before its own. The table may have changed meanwhile, so the item is compared.
_decoded: dict[str, deque[tuple[Mapping[str, Any], Batch]]] = {}
_TOPICS, _VALUES = 300, 2000


def keep_decoded(topic: str, item: Mapping[str, Any], batch: Batch) -> None:
    """Keep an item's decoded batch for the topic's next event."""
    if len(batch.times_us) * len(batch.columns) > _VALUES:
        return
    if len(_decoded) >= _TOPICS:
        _decoded.clear()
    kept = _decoded.setdefault(topic, deque(maxlen=2))
    if all(stored != item for stored, _ in kept):
        kept.append((item, batch))


class Stored(NamedTuple):
    """A batch as stored in the telemetry table, with the estimated memory of its columns. One ``beyond`` its
    second's limit only marks the start of the next second."""

    batch: Batch
    expires_s: int | None
    size: int
    beyond: bool = False


@dataclass
class Reader:
    """Reads one topic. ``known`` batches are not decoded again. ``check`` is called before every read and may
    raise. ``full`` lists the seconds found over their limit."""

    tables: Tables
    topic: str
    known: Mapping[BatchId, Batch]
    check: Callable[[], None]
    full: set[int] = field(default_factory=set)
    _near: tuple[int, list[BatchId]] = (-1, [])

    def read(self, first: int, last: int) -> tuple[list[Stored], int]:
        """The stored batches with samples from the first second to the last, the one before them, and all
        of the second in which the one after them starts; in order of time. And the last second that was
        read: where seconds hold much, it is an earlier one."""
        start_us, end_us = first * _SECOND_US, (last + 1) * _SECOND_US
        size = 0
        stored: list[Stored] = []
        after_s, passed = None, 0
        # One query: nearly always the batches are the newest, and nothing comes after them.
        at_once = sum(start_us <= t_us < end_us for t_us, _, _ in self.known) + _BESIDE
        for t_us, entry in self._bounded(start_us - MAX_BATCH_SPAN_US, at_once):
            if size >= _TOGETHER_BYTES and t_us >= start_us + _SECOND_US:
                end_us = min(end_us, t_us // _SECOND_US * _SECOND_US)
            if after_s is None and t_us >= end_us:
                passed += 1
            if passed > _NEIGHBOURS or (after_s is not None and t_us // _SECOND_US != after_s):
                break
            if entry is not None:
                stored.append(entry)
                size += entry.size
                if t_us >= end_us:
                    after_s = t_us // _SECOND_US
        if stored and stored[0].batch.t_us >= start_us:
            stored = [*self._before(stored[0].batch.t_us), *stored]
        return stored, end_us // _SECOND_US - 1

    def missing_before(self, batch: Batch, previous: Batch | None, stored: Sequence[Stored]) -> int:
        """The number of batches missing just before this one, by their sequence numbers."""
        if previous is not None and (previous.boot, previous.seq + 1) == (batch.boot, batch.seq):
            return 0
        # A robot may leave a hole before every batch.
        self.check()
        ids = [entry.batch.id for entry in stored]
        missing = missing_before(batch.id, ids, batch.previous)
        if missing:
            # Clocks may interleave: what is missing here may lie some seconds to the side.
            near = sorted({*ids, *self._numbers(batch.t_us // _SECOND_US)})
            missing = missing_before(batch.id, near, batch.previous)
        return missing

    def _numbers(self, second: int) -> list[BatchId]:
        """The batches of a second and to its sides, read once for all holes of the second."""
        if self._near[0] != second:
            start_us = second * _SECOND_US
            near = self.tables.numbers(self.topic, start_us - ASIDE_US, start_us + _SECOND_US + ASIDE_US)
            self._near = second, list(islice(near, _NUMBERS))
        return self._near[1]

    def _bounded(self, first_us: int, at_once: int) -> Iterator[tuple[int, Stored | None]]:
        """Yield (start, batch) from a time on; None instead of a batch that cannot be decoded. In a second
        over its limit, the rest except the last is skipped."""
        from_us: int | None = first_us
        while from_us is not None:
            start_us, from_us = from_us, None
            second, count, size, t_us = -1, 0, 0, -1
            entry: Stored | None = None
            for item in self.tables.batches_from(self.topic, start_us, at_once=at_once):
                # An invalid key still begins with a time, or sorts after all others.
                before_us, t_us = t_us, _time_of(item, t_us)
                if t_us // _SECOND_US != second:
                    second, count, size = t_us // _SECOND_US, 0, 0
                elif entry is not None:
                    size += entry.size
                if count >= SECOND_BATCHES or size >= _SECOND_BYTES:
                    self.full.add(second)
                    from_us = (second + 1) * _SECOND_US
                    for last in self._before(from_us):
                        if last.batch.t_us > before_us:
                            yield last.batch.t_us, last._replace(beyond=True)
                    break
                count += 1
                entry = next(self._stored([item]), None)
                yield t_us, entry

    def _before(self, t_us: int) -> list[Stored]:
        found = self._stored(islice(self.tables.before(self.topic, t_us), _NEIGHBOURS))
        return list(islice(found, 1))

    def _stored(self, items: Iterable[Mapping[str, Any]]) -> Iterator[Stored]:
        """The decodable items. An undecodable one is refused by its own record; here it only must not block
        its neighbours."""
        for item in items:
            try:
                batch = self.known.get(batch_id(item[BATCH])) or self._decoded(item)
                expires_s = int(item[EXPIRES_S]) if EXPIRES_S in item else None
            except (ContractError, KeyError, TypeError, ValueError, OverflowError):
                continue
            yield Stored(batch, expires_s, _bytes(batch))

    def _decoded(self, item: Mapping[str, Any]) -> Batch:
        for stored, batch in _decoded.get(self.topic, ()):
            if stored == item:
                return batch
        self.check()
        batch = decode_item(item)[1]
        keep_decoded(self.topic, item, batch)
        return batch


def _time_of(item: Mapping[str, Any], otherwise: int) -> int:
    try:
        return batch_id(item[BATCH]).t_us
    except ContractError:
        return otherwise


def _bytes(batch: Batch) -> int:
    """Estimated memory of the columns."""
    return sum(
        8 * len(column)
        + (sum(len(value) for value in column if type(value) is str) if str in set(map(type, column)) else 0)
        for column in batch.columns.values()
    )


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
