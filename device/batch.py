"""Collects the samples of one stream and says when they are a batch.

A batch closes
- when the next sample lies in another second of wall time, so that a batch lies within one second;
- when it spans ``batch_s``, or holds `MAX_VALUES` values, which is near the message limit;
- by the clock, a little after ``batch_s``, when the topic falls silent;
- when the set of fields changes: a missing field is not the same as a null one, so both stay as
  they were, in two batches;
- when time steps back by a second or more.

Within a stream, times strictly increase, because they are the samples' keys. A stamp that is not
later than the one before, by less than a second, becomes one microsecond later than that; such
samples are counted as ``restamped``.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Callable, List, Mapping

from contract import MAX_SAMPLES, Value
from device.clock import Clock

STEP_BACK_US = 1_000_000
# Real telemetry takes about 2 bytes a value in a message, random doubles 12; what is too large all
# the same is split when it is packed.
MAX_VALUES = 20_000
# The sample that closes a batch by itself may come a little after batch_s.
_GRACE_S = 0.1


@dataclass
class StreamCounts:
    """What became of a stream's samples since the start."""

    samples: int = 0
    batches: int = 0
    refused: int = 0
    restamped: int = 0
    nulled: int = 0


# Takes a closed batch: the samples' times and the samples, at least one, all with the same fields.
Store = Callable[[List[int], List[Mapping[str, Value]]], None]


class Batcher:
    """The open batch of one stream. Safe to use from several threads."""

    def __init__(self, store: Store, *, batch_s: float, clock: Clock, counts: StreamCounts) -> None:
        self._store = store
        self._batch_s = batch_s
        self._batch_us = round(batch_s * 1_000_000)
        self._clock = clock
        self._counts = counts
        self._lock = threading.Lock()
        self._times: list[int] = []
        self._samples: list[Mapping[str, Value]] = []
        self._fields: object = None
        self._second = 0
        self._full = 0
        self._last_us: int | None = None
        self._opened = 0.0

    def add(self, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample; the mapping must not change afterwards."""
        with self._lock:
            self._counts.samples += 1
            last = self._last_us
            if last is not None and t_us <= last:
                if last - t_us < STEP_BACK_US:
                    t_us = last + 1
                    self._counts.restamped += 1
                else:
                    self._close()
            self._last_us = t_us
            times = self._times
            if times and (
                t_us // 1_000_000 != self._second
                or t_us - times[0] >= self._batch_us
                or len(times) >= self._full
                or values.keys() != self._fields
            ):
                self._close()
            if not self._times:
                self._opened = self._clock.monotonic()
                self._second = t_us // 1_000_000
                self._fields = values.keys()
                self._full = min(MAX_SAMPLES, max(1, MAX_VALUES // max(1, len(values))))
            self._times.append(t_us)
            self._samples.append(values)
            if not self._batch_us:
                self._close()

    def tick(self) -> None:
        """Close the batch of a topic that has fallen silent."""
        with self._lock:
            if self._times and self._clock.monotonic() - self._opened >= self._batch_s + _GRACE_S:
                self._close()

    def flush(self) -> None:
        """Close the batch, whatever it holds."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._times:
            times, samples = self._times, self._samples
            self._times, self._samples = [], []
            self._store(times, samples)
