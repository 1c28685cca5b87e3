"""Takes every sample: offers it to the live lane and adds it to its stream's batch for the record lane."""

from __future__ import annotations

import threading
from typing import Iterable, Mapping

from iort_agent.clock import Clock
from iort_agent.lanes.batch_encoder import BatchEncoder, StreamCounts
from iort_agent.lanes.config import RuntimeSettings
from iort_agent.lanes.live import LiveLane
from iort_agent.spool.interface import Spool
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import Value
from iort_contract.topics import check_stream

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

    def emit(self, stream: str, t_us: int, values: Mapping[str, Value], *, urgent: bool = False) -> None:
        """Take a sample for both lanes; an ``urgent`` one waits for no slow rate of the live lane."""
        if stream == TYPES_STREAM:
            # The live lane shows no message types.
            self._keep_type(values)
            self.record(stream, t_us, values)
            return
        if self.settings.fields and stream in self.settings.fields:
            self._fields.setdefault(stream, values.keys())
            values = {name: values[name] for name in self.settings.fields[stream] if name in values}
        # First, because its delay counts.
        self._live.offer(stream, t_us, values, urgent=urgent)
        self.record(stream, t_us, values)

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

    def tick(self) -> None:
        """Close the batches of silent streams; called several times a second."""
        for encoder in list(self._encoders.values()):
            encoder.tick()

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
