"""Takes every sample: offers it to the live lane and adds it to its stream's batch for the record lane."""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import dataclass, field, replace
from typing import Iterable, Mapping, Sequence

from iort_agent.common.threads import Clock
from iort_agent.lanes import RuntimeSettings
from iort_agent.lanes.live import LiveLane
from iort_agent.spool import Spool
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import MAX_SAMPLES, Value
from iort_contract.messages.batch import MAX_BYTES, MAX_VALUES, Sample, batches_of, encode_fitting
from iort_contract.ros.message import RosMessage
from iort_contract.topics import check_stream

_log = logging.getLogger(__name__)

# The sample that closes a batch by itself may come a little after batch_s.
_GRACE_S = 0.1
_MOST_OPEN = 8


@dataclass
class StreamCounts:
    """What became of a stream's samples since the start: ``samples`` were taken, and ``stored`` of them put
    into the queue, in ``batches`` numbered from 0; ``refused`` cannot be sent; ``nulled`` values were not
    finite."""

    samples: int = 0
    stored: int = 0
    batches: int = 0
    refused: int = 0
    nulled: int = 0


@dataclass
class _Open:
    opened: float
    samples: list[Sample] = field(default_factory=list)
    full: float = 0.0


class BatchEncoder:
    """Collects the samples of one stream of a run into batches, and puts these as messages into the spool.

    A batch lies within one second of the samples' own time. Clocks may interleave, as two publishers' do if
    one of them is behind: each second that is open has a batch of its own. A batch closes
    - with the first sample of another second, once it is about ``batch_s`` old;
    - when it is full: `MAX_VALUES` values, or `MAX_BYTES` of messages, which is near the message limit;
    - by the clock, a little after ``batch_s``, when the topic falls silent;
    - when too many seconds are open at once, as in a recording that is played fast: the oldest first.

    Samples of one time stay two samples. Within a batch they are in order of time, and as they came if the
    time is the same. Safe to use from several threads.
    """

    def __init__(self, stream: str, *, boot: str, batch_s: float, spool: Spool, clock: Clock) -> None:
        self._stream, self._boot, self._spool, self._clock = stream, boot, spool, clock
        self._batch_s = batch_s
        self._batch_us = round(batch_s * 1_000_000)
        self._counts = StreamCounts()
        self._lock = threading.Lock()
        # By the part of time that they hold, oldest first.
        self._open: dict[tuple[int, int], _Open] = {}
        # No batch is to be closed before: of fifty topics, few have one at a tick.
        self.due = math.inf

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
                self.due = min(self.due, now + self._batch_s + _GRACE_S)
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
            return StreamCounts(*vars(self._counts).values())

    def tick(self) -> float:
        """Close the batches of a topic that has fallen silent; when the next one is due."""
        age_s = self._batch_s + _GRACE_S
        with self._lock:
            if self._open:
                self._close_older(self._clock.monotonic(), age_s)
            self.due = min((batch.opened for batch in self._open.values()), default=math.inf) + age_s
            return self.due

    def flush(self) -> None:
        """Close every batch, whatever it holds."""
        with self._lock:
            for slot in list(self._open):
                self._close(slot)

    def _close_older(self, now: float, age_s: float) -> None:
        for slot in [slot for slot, batch in self._open.items() if now - batch.opened >= age_s]:
            self._close(slot)

    def _close(self, slot: tuple[int, int]) -> None:
        """Put the samples into the spool, in as many messages as they need."""
        for batch in batches_of(self._boot, self._open.pop(slot).samples):
            previous = self._spool.previous(self._stream)
            fitting, problems = encode_fitting(replace(batch, seq=self._counts.batches, previous=previous))
            for one, payload in fitting:
                n = len(one.times_us)
                self._spool.put(self._stream, one.boot, one.seq, payload, samples=n)
                self._counts.batches += 1
                self._counts.stored += n
                self._counts.nulled += _nonfinite(one.columns)
            for problem in problems:
                self._refuse(problem)

    def _refuse(self, why: str) -> None:
        self._counts.refused += 1
        # A stream that is wrong is wrong at its full rate; the first one says it all.
        level = logging.WARNING if self._counts.refused == 1 else logging.DEBUG
        _log.log(level, "stream %s: a sample cannot be sent: %s", self._stream, why)


def _nonfinite(columns: Mapping[str, Sequence[Value]]) -> int:
    return sum(map(_nonfinite_of, columns.values()))


def _nonfinite_of(column: Sequence[Value]) -> int:
    try:
        if all(map(math.isfinite, column)):  # type: ignore[arg-type]  # what is no number is told apart below
            return 0
    except (TypeError, OverflowError):
        pass  # a text, a null, or an integer beyond every float among them
    return sum(type(value) is float and not math.isfinite(value) for value in column)


_MOST_TYPES = 1024


class Streams:
    """The streams of one run. Safe to use from several threads."""

    def __init__(
        self,
        *,
        boot: str,
        batch_s: float,
        settings: RuntimeSettings,
        live: LiveLane,
        spool: Spool,
        clock: Clock,
    ) -> None:
        self._boot, self._batch_s = boot, batch_s
        self._live, self._spool, self._clock = live, spool, clock
        self.settings = settings
        self._lock = threading.Lock()
        self._encoders: dict[str, BatchEncoder] = {}
        # The message types that sources have emitted, under lock.
        self._types: dict[tuple[Value, ...], Mapping[str, Value]] = {}
        self._fields: dict[str, Iterable[str]] = {}

    def emit(
        self,
        stream: str,
        t_us: int,
        values: Mapping[str, Value],
        *,
        urgent: bool = False,
        more: bool = False,
    ) -> float:
        """Take a sample for both lanes, as an `iort_agent.sources.Emit`; an ``urgent`` one waits for no slow
        rate of the live lane."""
        if stream == TYPES_STREAM:
            # The live lane shows no message types.
            self._keep_type(values)
            self.record(stream, t_us, values)
            return 0.0
        if self.settings.fields and stream in self.settings.fields:
            self._fields.setdefault(stream, values.keys())
            values = {name: values[name] for name in self.settings.fields[stream] if name in values}
        # First, because its delay counts.
        next_at = self._live.offer(stream, t_us, values, urgent=urgent, more=more)
        self.record(stream, t_us, values)
        return next_at

    def record(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample for the record lane only."""
        encoder = self._encoders.get(stream)
        if encoder is None:
            encoder = self._new_encoder(stream, values)
        if self.settings.record_enabled:
            encoder.add(t_us, values)

    def apply(self, settings: RuntimeSettings) -> None:
        """Use other settings from now on."""
        resumes = settings.record_enabled and not self.settings.record_enabled
        self.settings = settings
        if resumes:
            self.repeat_types()

    def tick(self) -> float:
        """Close the batches of silent streams; when the next one is due."""
        now, encoders = self._clock.monotonic(), list(self._encoders.values())
        return min([one.tick() if now >= one.due else one.due for one in encoders], default=math.inf)

    def flush(self) -> None:
        """Close every batch."""
        for encoder in list(self._encoders.values()):
            encoder.flush()

    def repeat_types(self) -> None:
        """Record the message types again. A reader needs them to turn columns into messages, and the earlier
        records may be missing: dropped by the queue, expired, or never made."""
        with self._lock:
            types = list(self._types.values())
        for values in types:
            self.record(TYPES_STREAM, self._clock.now_us(), values)

    def known_fields(self) -> dict[str, Iterable[str]]:
        """The fields of each stream's first sample."""
        return dict(self._fields)

    def counts(self) -> dict[str, StreamCounts]:
        """The counts of each stream, each of one moment."""
        return {name: encoder.counts() for name, encoder in list(self._encoders.items())}

    def refused(self) -> int:
        """The samples of all streams that cannot be sent."""
        return sum(counts.refused for counts in self.counts().values())

    def _keep_type(self, values: Mapping[str, Value]) -> None:
        key = tuple(values.get(name) for name in ("stream", "topic", "kind", "md5sum"))
        with self._lock:
            self._types[key] = values
            if len(self._types) > _MOST_TYPES:
                del self._types[next(iter(self._types))]

    def _new_encoder(self, stream: str, values: Mapping[str, Value]) -> BatchEncoder:
        with self._lock:
            if stream not in self._encoders:
                check_stream(stream)
                self._fields.setdefault(stream, values.keys())
                self._encoders[stream] = BatchEncoder(
                    stream, boot=self._boot, batch_s=self._batch_s, spool=self._spool, clock=self._clock
                )
            return self._encoders[stream]
