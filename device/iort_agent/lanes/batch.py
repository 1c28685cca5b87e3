"""Collects the samples of one stream and says when they are a batch.

A batch lies within one second of the samples' own time. Clocks may interleave, as those of two publishers do
of which one is behind: each second that is open has a batch of its own. A batch closes
- with the first sample of another second, once it is about ``batch_s`` old;
- when it is full: `MAX_VALUES` values, or `MAX_BYTES` of messages, which is near the message limit;
- by the clock, a little after ``batch_s``, when the topic falls silent;
- when too many seconds are open at once, as in a recording that is played fast: the oldest first.

Samples of one time stay two samples. Within a batch they are in order of time, and as they came where that
is the same.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Callable, List, Mapping, Tuple

from iort_agent.clock import Clock
from iort_contract.limits import MAX_SAMPLES, Value
from iort_contract.ros1.message import RosMessage

# Real telemetry takes about 2 bytes a value in a message, random doubles 12; what is too large all
# the same is split when it is packed.
MAX_VALUES = 20_000
# Of serialized messages, which pack to between a tenth and all of it, and a third more as text.
MAX_BYTES = 96 * 1024
# The sample that closes a batch by itself may come a little after batch_s.
_GRACE_S = 0.1
_MOST_OPEN = 8


@dataclass
class StreamCounts:
    """What became of a stream's samples since the start: ``samples`` were taken, and ``stored`` of them put
    into the queue, in ``batches`` numbered from ``first_seq``; ``refused`` cannot be sent; ``nulled`` values
    were not finite."""

    samples: int = 0
    stored: int = 0
    batches: int = 0
    refused: int = 0
    nulled: int = 0
    first_seq: int = 0


Sample = Tuple[int, Mapping[str, Value]]
# Takes a closed batch: samples with their times in microseconds, at least one, in order of time.
Store = Callable[[List[Sample]], None]


@dataclass
class _Open:
    opened: float
    samples: list[Sample] = field(default_factory=list)
    full: float = 0.0


class Batcher:
    """The open batches of one stream. Safe to use from several threads."""

    def __init__(self, store: Store, *, batch_s: float, clock: Clock, counts: StreamCounts) -> None:
        self._store = store
        self._batch_s = batch_s
        self._batch_us = round(batch_s * 1_000_000)
        self._clock = clock
        self._counts = counts
        self._lock = threading.Lock()
        # By the part of time that they hold, oldest first.
        self._open: dict[tuple[int, int], _Open] = {}

    def add(self, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample; the mapping must not change afterwards."""
        second, within_us = divmod(t_us, 1_000_000)
        slot = (second, within_us // self._batch_us if self._batch_us else 0)
        with self._lock:
            self._counts.samples += 1
            batch = self._open.get(slot)
            if batch is None:
                now = self._clock.monotonic()
                self._close_older(now, self._batch_s - _GRACE_S)
                while len(self._open) >= _MOST_OPEN:
                    self._close(next(iter(self._open)))
                batch = self._open[slot] = _Open(now)
            batch.samples.append((t_us, values))
            # Only to know when to close: looking into each message would cost more than keeping it.
            if isinstance(values, RosMessage):
                batch.full += (len(values.raw) + 1) / MAX_BYTES
            else:
                batch.full += max(1, len(values)) / MAX_VALUES
            if batch.full >= 1 or len(batch.samples) >= MAX_SAMPLES or not self._batch_us:
                self._close(slot)

    def counts(self) -> StreamCounts:
        """The counts of one moment."""
        with self._lock:
            return replace(self._counts)

    def tick(self) -> None:
        """Close the batches of a topic that has fallen silent."""
        with self._lock:
            if self._open:
                self._close_older(self._clock.monotonic(), self._batch_s + _GRACE_S)

    def flush(self) -> None:
        """Close every batch, whatever it holds."""
        with self._lock:
            for slot in list(self._open):
                self._close(slot)

    def _close_older(self, now: float, age_s: float) -> None:
        for slot in [slot for slot, batch in self._open.items() if now - batch.opened >= age_s]:
            self._close(slot)

    def _close(self, slot: tuple[int, int]) -> None:
        samples = self._open.pop(slot).samples
        samples.sort(key=itemgetter(0))
        self._store(samples)
