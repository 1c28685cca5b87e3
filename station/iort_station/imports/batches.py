"""Cuts a recording into the batches that an agent would have made of it. They depend on its content alone, so
an interrupted import makes the same ones again.

Whole messages that go into the archive are cut, flattened and hashed many at a time; everything else goes
sample by sample, as in the agent.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.archive.writing import Head, Piece, field_list, piece
from iort_analysis.samples.blocks import Block
from iort_analysis.samples.messages import Flattener, together
from iort_contract.archive import Hour, hour_of
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.dynamodb import Item
from iort_contract.limits import MAX_BATCH_VALUES, MAX_MESSAGE_BYTES, MAX_SAMPLES, MessageError, Value
from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import (
    MAX_BYTES,
    Batch,
    BatchId,
    Sample,
    batches_of,
    encode_fitting,
)
from iort_contract.recordings.rosbag import BELIEVABLE_NS, Kind
from iort_contract.ros.decode import Decoder, stamp_ns
from iort_contract.ros.message import Messages, RosMessage, RosType
from iort_contract.ros.plan import CDR_LITTLE
from iort_station.imports.stores import Store, item_of

_SECOND_US = 1_000_000
# A batch is complete once messages were recorded so much later: a publisher's clock may be behind.
_SETTLED_US = 10_000_000
# Messages of a stream that wait to be cut, and of all streams.
_WAITING_BYTES, _ALL_WAITING_BYTES = 16 * 1024 * 1024, 64 * 1024 * 1024
# Samples that are kept as Python's values.
_WAITING_SAMPLES = 4_000
# A message of fewer bytes always fits: base64 takes a third more.
_ALWAYS_FITS = MAX_MESSAGE_BYTES // 2
_END_US = 2**62
# MCAP has times that are larger: nobody believes either.
_MOST_NS = 2**63 - 1
# Before 2000 a clock is not set.
FIRST_US = 946_684_800_000_000


class Times(NamedTuple):
    """The times that are believed, both inclusive; and what is added to a recording's own."""

    first_us: int
    last_us: int
    shift_us: int = 0


@dataclass
class Counts:
    """What became of a stream's samples, as an agent counts them."""

    taken: int = 0
    stored: int = 0
    refused: int = 0
    nulled: int = 0
    batches: int = 0
    why: str = ""


@dataclass
class _Waiting:
    kinds: list[Kind] = field(default_factory=list)
    recorded_ns: list[int] = field(default_factory=list)
    raws: list[bytes] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    size: int = 0


class Run:
    """One recording as a run of the agent."""

    def __init__(
        self, topics: Mapping[str, str], boot: str, store: Store, times: Times, retention_s: int
    ) -> None:
        """``topics`` has the topic of each stream."""
        self._topics, self._boot, self._store, self._times = topics, boot, store, times
        self._retention_s = retention_s
        self._waiting: dict[str, _Waiting] = {}
        self._flatteners: dict[tuple[str, str], Flattener] = {}
        self._size = 0
        self.counts: dict[str, Counts] = {}
        # Messages with a time that nobody believes, by stream.
        self.without_time: Counter[str] = Counter()
        self.last_us = 0

    def message(self, kind: Kind, recorded_ns: int, raw: bytes) -> None:
        """Take a whole message."""
        stream = kind.stream
        if not self._store.takes_pieces:
            self.sample(stream, time_of(kind, recorded_ns, raw), RosMessage(raw, kind.whole))
            return
        waiting = self._waiting.get(stream)
        if waiting is None:
            waiting = self._waiting[stream] = _Waiting()
        waiting.kinds.append(kind)
        waiting.recorded_ns.append(min(recorded_ns, _MOST_NS))
        waiting.raws.append(raw)
        size = len(raw)
        waiting.size += size
        self._size += size
        if waiting.size >= _WAITING_BYTES or len(waiting.raws) >= 4 * MAX_SAMPLES:
            self._cut(stream)
        elif self._size >= _ALL_WAITING_BYTES:
            self._cut(max(self._waiting, key=lambda name: self._waiting[name].size))

    def sample(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample, or a message as one."""
        t_us += self._times.shift_us
        counts = self.counts.setdefault(stream, Counts())
        if not self._times.first_us <= t_us <= self._times.last_us:
            self.without_time[stream] += 1
            return
        counts.taken += 1
        self.last_us = max(self.last_us, t_us)
        waiting = self._waiting.setdefault(stream, _Waiting())
        waiting.samples.append((t_us, values))
        if isinstance(values, RosMessage):
            waiting.size += len(values.raw)
        if len(waiting.samples) >= _WAITING_SAMPLES or waiting.size >= _WAITING_BYTES:
            self._cut_samples(stream)

    def settle(self, before: Hour) -> None:
        """Cut all that lies before an hour, to which nothing comes any more."""
        for stream in list(self._waiting):
            self._cut(stream, until_us=before.start_us)
            self._cut_samples(stream, until_us=before.start_us)

    def end(self, source: str, losses: Mapping[str, int]) -> None:
        """Cut everything, and add the run's account as an agent does at its end."""
        for stream in list(self._waiting):
            self._cut(stream, until_us=_END_US)
            self._cut_samples(stream, until_us=_END_US)
        at_us = self.last_us - self._times.shift_us
        for stream, counts in sorted(self.counts.items()):
            account = StreamAccount(
                stream,
                counts.taken,
                counts.stored,
                counts.refused,
                counts.nulled,
                first_seq=0,
                next_seq=counts.batches,
                ended=True,
                durable=True,
            )
            self.sample(ACCOUNT_STREAM, at_us, account.sample())
        losses = {**losses, **{f"{stream}.not_a_time": count for stream, count in self.without_time.items()}}
        if lost := {path: count for path, count in losses.items() if count}:
            self.sample(ACCOUNT_STREAM, at_us, SourceAccount(source, lost).sample())
        if ACCOUNT_STREAM in self._waiting:
            self._cut_samples(ACCOUNT_STREAM, until_us=_END_US)

    # Sample by sample.

    def _cut_samples(self, stream: str, *, until_us: int | None = None) -> None:
        """Cut what waits of a stream before a time; None leaves the newest seconds, of which there may be
        more."""
        waiting = self._waiting[stream]
        samples = sorted(waiting.samples, key=lambda one: one[0])
        if until_us is None:
            until_us = _settled(np.array([t_us for t_us, _ in samples], dtype=np.int64))
        ready = [one for one in samples if one[0] < until_us]
        waiting.samples = samples[len(ready) :]
        if not waiting.raws:
            waiting.size = sum(len(v.raw) for _, v in waiting.samples if isinstance(v, RosMessage))
        items: list[Item] = []
        for second in _seconds(ready):
            for batch in batches_of(self._boot, second):
                items += self._items(stream, batch)
        if items:
            self._store.items(stream, sorted(items, key=lambda item: str(item["batch"]["S"])))

    def _items(self, stream: str, batch: Batch) -> Iterator[Item]:
        counts = self.counts[stream]
        numbered = Batch(
            batch.boot, counts.batches, batch.times_us, batch.columns, batch.nonfinite, batch.messages, ()
        )
        fitting, problems = encode_fitting(numbered)
        for one, payload in fitting:
            counts.batches += 1
            counts.stored += len(one.times_us)
            message = json.loads(payload)
            counts.nulled += int(message.get("nonfinite", 0))
            received_ms = one.times_us[-1] // 1000
            expires_s = received_ms // 1000 + self._retention_s
            yield item_of(self._topics[stream], one, message, received_ms, expires_s)
        counts.refused += len(problems)
        counts.why = counts.why or next(iter(problems), "")

    # Many messages at once.

    def _cut(self, stream: str, *, until_us: int | None = None) -> None:
        """As `_cut_samples`, of whole messages."""
        waiting, counts = self._waiting[stream], self.counts.setdefault(stream, Counts())
        if not waiting.raws:
            return
        times_us, kinds, number_of = _times(waiting)
        times_us += self._times.shift_us
        good = (times_us >= self._times.first_us) & (times_us <= self._times.last_us)
        settled = times_us < (_settled(times_us[good]) if until_us is None else until_us)
        rows = np.flatnonzero(settled & good)
        self.without_time[stream] += int((settled & ~good).sum())
        raws = waiting.raws
        some = _Some(times_us[rows], kinds, number_of[rows], [raws[row] for row in rows.tolist()])
        counts.taken += len(rows)
        fits = self._fit(counts, some)
        if not fits.all():
            chosen = np.flatnonzero(fits)
            some = _Some(
                some.times_us[chosen], kinds, some.number_of[chosen], [some.raws[i] for i in chosen.tolist()]
            )
        if some.raws:
            self.last_us = max(self.last_us, int(some.times_us.max()))
            for hour, one, hashes in self._pieces(some, counts):
                self._store.piece(stream, hour, one, hashes)
        rest = np.flatnonzero(~settled).tolist()
        left = _Waiting(
            [waiting.kinds[i] for i in rest],
            [waiting.recorded_ns[i] for i in rest],
            [raws[i] for i in rest],
            waiting.samples,
            sum(len(raws[i]) for i in rest),
        )
        self._size -= waiting.size - left.size
        self._waiting[stream] = left

    def _fit(self, counts: Counts, some: _Some) -> NDArray[np.bool_]:
        """Which messages an agent could send: a large one is compressed to know it."""
        fits = np.ones(len(some.raws), dtype=np.bool_)
        for i, raw in enumerate(some.raws):
            if len(raw) <= _ALWAYS_FITS:
                continue
            kind = some.kinds[some.number_of[i]]
            messages = Messages(kind.id, kind.layout, [raw])
            problems = encode_fitting(Batch(self._boot, 0, [0], {}, 0, messages, ()))[1]
            if problems:
                fits[i] = False
                counts.refused += 1
                counts.why = counts.why or problems[0]
        return fits

    def _pieces(self, some: _Some, counts: Counts) -> Iterator[tuple[Hour, Piece, list[tuple[str, str]]]]:
        """The messages as batches: a piece for each hour."""
        columns, shapes, shape_of = self._flat(some)
        order = np.lexsort((some.times_us, some.number_of, some.times_us // _SECOND_US))
        times_us, sizes = some.times_us[order], np.fromiter(map(len, some.raws), np.int64)[order]
        most = min(MAX_SAMPLES, max(1, MAX_BATCH_VALUES // max(1, len(columns))))
        batches: list[tuple[str, int, int]] = []
        for start, end in _cuts(times_us, some.number_of[order], sizes, most):
            batch = BatchId(int(times_us[start]), self._boot, counts.batches)
            counts.batches += 1
            batches.append((str(batch), start, end))
        counts.stored += len(order)
        batches.sort()
        rows = order[np.concatenate([np.arange(start, end) for _, start, end in batches])]
        raws, times_us = [some.raws[row] for row in rows.tolist()], some.times_us[rows]
        block = Block(times_us, {name: column[rows] for name, column in columns.items()})
        numbers, shaped, at = some.number_of[rows], shape_of[rows], 0
        by_hour: dict[Hour, tuple[int, list[Head]]] = {}
        for name, start, end in batches:
            until = at + end - start
            kind = some.kinds[numbers[at]]
            own = dict.fromkeys(
                field for one in dict.fromkeys(shaped[at:until].tolist()) for field in shapes[one]
            )
            digest = hashlib.blake2b(digest_size=8)
            digest.update(kind.id.encode())
            digest.update(times_us[at:until].tobytes())
            digest.update(b"".join(raws[at:until]))
            last_ms = int(times_us[until - 1]) // 1000
            head = Head(
                name, end - start, last_ms, None, "", digest.hexdigest(), field_list((), list(own)), None,
                kind.id, kind.layout,
            )  # fmt: skip
            by_hour.setdefault(hour_of(int(name[:16])), (at, []))[1].append(head)
            at = until
        for hour, (first, heads) in by_hour.items():
            part = slice(first, first + sum(head.n for head in heads))
            yield hour, piece(heads, block.take(part), raws[part]), [(head.id, head.hash) for head in heads]

    def _flat(self, some: _Some) -> tuple[dict[str, NDArray[Any]], list[Sequence[str]], NDArray[np.intp]]:
        """All messages as columns; the names that some have, and which each has."""
        parts: list[tuple[NDArray[np.intp], dict[str, NDArray[Any]]]] = []
        shapes: list[Sequence[str]] = []
        shape_of = np.zeros(len(some.raws), dtype=np.intp)
        for number, kind in enumerate(some.kinds):
            rows = np.flatnonzero(some.number_of == number)
            if not len(rows):
                continue
            # A recording may say one hash of two definitions.
            flattener = self._flatteners.get((kind.id, kind.definition))
            if flattener is None:
                flattener = self._flatteners[kind.id, kind.definition] = Flattener(kind)
            flat = flattener.flat([some.raws[row] for row in rows.tolist()])
            shape_of[rows] = flat.shape_of + len(shapes)
            shapes += flat.shapes
            parts.append((rows, flat.columns))
        return together(parts, len(some.raws)), shapes, shape_of


def _settled(times_us: NDArray[np.int64]) -> int:
    """The time before which a batch is complete, by the messages that came."""
    if not len(times_us):
        return _END_US
    newest_us = int(times_us.max())
    settled_us = (newest_us - _SETTLED_US) // _SECOND_US * _SECOND_US
    # All may be of some seconds, or of one time.
    first_us = int(times_us.min())
    return settled_us if first_us < settled_us else max(newest_us, first_us + 1)


class _Some(NamedTuple):
    """Messages with their times, and the number of each one's type among the kinds."""

    times_us: NDArray[np.int64]
    kinds: Sequence[RosType]
    number_of: NDArray[np.intp]
    raws: list[bytes]


def time_of(kind: Kind, recorded_ns: int, raw: bytes) -> int:
    """A message's time in microseconds: its header's stamp, if that is believable, or that of recording."""
    measured_ns = stamp_ns(raw, ros2=kind.whole.ros2) if kind.stamped else None
    if measured_ns is None or abs(measured_ns - recorded_ns) >= BELIEVABLE_NS:
        return recorded_ns // 1000
    return measured_ns // 1000


def _times(waiting: _Waiting) -> tuple[NDArray[np.int64], list[RosType], NDArray[np.intp]]:
    """`time_of` each message, the types, and the number of each message's."""
    raws = waiting.raws
    times_ns = np.array(waiting.recorded_ns, dtype=np.int64)
    ids = np.fromiter(map(id, waiting.kinds), dtype=np.int64, count=len(raws))
    _, firsts, number_of = np.unique(ids, return_index=True, return_inverse=True)
    # In the order of the recording, because the batches of each import have the same numbers.
    kinds = [waiting.kinds[first] for first in sorted(firsts.tolist())]
    number_of = np.argsort(np.argsort(firsts))[number_of]
    for number, kind in enumerate(kinds):
        rows = np.flatnonzero(number_of == number)
        if not kind.stamped:
            continue
        some = [raws[row] for row in rows.tolist()]
        if all(len(raw) >= 16 and (not kind.whole.ros2 or raw[:2] == CDR_LITTLE) for raw in some):
            heads = np.frombuffer(b"".join([raw[4:12] for raw in some]), dtype="<u4").reshape(-1, 2)
            seconds = heads[:, 0].astype(np.int32 if kind.whole.ros2 else np.int64)
            stamps = seconds.astype(np.int64) * 1_000_000_000 + heads[:, 1]
            believed = np.abs(stamps - times_ns[rows]) < BELIEVABLE_NS
            times_ns[rows[believed]] = stamps[believed]
        else:
            times_ns[rows] = [
                1000 * time_of(kind, recorded_ns, raw)
                for recorded_ns, raw in zip(times_ns[rows].tolist(), some, strict=True)
            ]
    return times_ns // 1000, [kind.whole for kind in kinds], number_of


def _cuts(
    times_us: NDArray[np.int64], number_of: NDArray[np.intp], sizes: NDArray[np.int64], most: int
) -> Iterator[tuple[int, int]]:
    """The batches of messages that are in order: each of one second and type, and full as an agent's."""
    seconds = times_us // _SECOND_US
    changes = np.flatnonzero((seconds[1:] != seconds[:-1]) | (number_of[1:] != number_of[:-1])) + 1
    edges = [0, *changes.tolist(), len(times_us)]
    filled = np.concatenate([[0], np.cumsum(sizes + 1)])
    for start, end in pairwise(edges):
        at = start
        while at < end:
            # As many as fit; the one that fills it belongs to it, unless the others are large already.
            until = int(np.searchsorted(filled, filled[at] + MAX_BYTES, side="left"))
            until = max(at + 1, min(until, at + most, end))
            yield at, until
            at = until


def _seconds(samples: Sequence[Sample]) -> Iterator[list[Sample]]:
    """Samples in order of time, those of a second together, and no more than an agent's batch has."""
    group: list[Sample] = []
    size = 0
    for sample in samples:
        if group and (sample[0] // _SECOND_US != group[0][0] // _SECOND_US or size >= MAX_BYTES):
            yield group
            group, size = [], 0
        group.append(sample)
        size += len(sample[1].raw) + 1 if isinstance(sample[1], RosMessage) else 5 * len(sample[1])
    if group:
        yield group


def selected(decoder: Decoder, raw: bytes) -> Mapping[str, Value] | None:
    """The selected fields of a message; None without any."""
    try:
        return decoder.decode(raw) or None
    except MessageError:
        return None
