"""Reads the telemetry table around the batches of an event, within the limits of a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

from functions.shared.tables import Tables
from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_COLUMNS_BYTES, ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id, decode_item
from iort_contract.statistics import ASIDE_US, missing_before
from iort_contract.tables import BATCH, EXPIRES_S

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
        self.check()
        return decode_item(item)[1]


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
