"""One run of the agent: its threads, what they do in turn, and the order in which they end."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Callable, Sequence

from iort_agent.account import Accounts
from iort_agent.clock import Clock
from iort_agent.config.file import Config
from iort_agent.control.downlink import Downlink
from iort_agent.control.runtime_settings import Tuning
from iort_agent.control.shadow import Remote
from iort_agent.files.folder import Uploads
from iort_agent.lanes.attachment import ClaimCheck
from iort_agent.lanes.clock_offset import ClockOffset
from iort_agent.lanes.live import LiveLane
from iort_agent.lanes.pings import Pings
from iort_agent.lanes.record import TODO, RecordLane, too_many
from iort_agent.logs import Troubles
from iort_agent.metrics import AgentMetrics, Rates
from iort_agent.mqtt.uplink import Uplink
from iort_agent.sources import Emit
from iort_agent.sources.run import SourceRun
from iort_agent.spool.interface import Spool
from iort_agent.streams import Streams
from iort_contract.catalog.streams import AGENT_STREAM, OWN_STREAMS

_log = logging.getLogger(__name__)

# The most by which the last live sample and the last batch of a silent stream are late.
_TICK_S = 0.2
_RATES_S = 1.0
_TYPES_S = 3600.0
_CLOSE_S = 5.0
# A warm Lambda function answers well within this.
_LAST_PONGS_S = 2.0


@dataclass(frozen=True)
class Parts:
    """The parts of an agent. ``began`` is the monotonic time of its start; ``tune`` applies other settings
    to all parts, at once and from any thread."""

    config: Config
    boot: str
    began: float
    clock: Clock
    uplink: Uplink
    spool: Spool
    streams: Streams
    record: RecordLane
    live: LiveLane
    pings: Pings
    offset: ClockOffset
    shadow: Remote
    tune: Callable[[Tuning], None]
    sources: Sequence[SourceRun]
    accounts: Accounts
    metrics: AgentMetrics
    rates: Rates
    downlink: Downlink | None
    uploads: Uploads | None
    attachments: ClaimCheck | None
    troubles: Troubles | None


class Runtime:
    """Runs the parts. `run` is called once."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self._stop = threading.Event()

    def stop(self) -> None:
        """End the run in good order; call it from any thread, or from a signal handler."""
        self._stop.set()

    def run(self, *, drain_s: float) -> int:
        """Run until every source has ended or `stop` is called, then deliver what is left.

        Returns the exit status: 1 if a source failed or ended with no sample stored, or if a batch was
        dropped or could not be delivered within ``drain_s``; else 0. Raises `UplinkError` if the uplink
        cannot start.
        """
        parts = self.parts
        problem = too_many(parts.config.sources, parts.config.record)
        if problem is not None:
            _log.warning("record: %s; %s", problem, TODO)
        parts.uplink.start()
        if parts.downlink is not None:
            parts.downlink.start()
        record_stop, uploads_stop = threading.Event(), threading.Event()
        record = _start("record", lambda: parts.record.run(record_stop))
        ticker = _start("ticker", self._tick_until_stop)
        sources = [self._start_source(i, source) for i, source in enumerate(parts.sources)]
        watcher = _start("watcher", lambda: self._stop_after(sources))
        pinger = _start("pings", lambda: parts.pings.run(self._stop))
        uploads = parts.uploads
        uploader = None if uploads is None else _start("uploads", lambda: uploads.run(uploads_stop))
        self._stop.wait()
        if parts.downlink is not None:
            parts.downlink.halt()
        parts.pings.wake()
        for thread in (*sources, watcher, ticker, pinger):
            thread.join()
        parts.pings.close(min(_LAST_PONGS_S, drain_s))
        delivered = self._drain(drain_s)
        self._check_sources()
        if parts.downlink is not None:
            parts.downlink.close()
        self._end_uploads(uploader, uploads_stop, drain_s)
        record_stop.set()
        parts.record.wake()
        record.join()
        parts.uplink.stop(_CLOSE_S)
        return 0 if delivered and not any(source.failed for source in parts.sources) else 1

    def tick(self) -> None:
        """Let streams and lanes do what is due; `run` calls it several times a second."""
        self.parts.streams.tick()
        self.parts.record.tick()
        self.parts.live.tick()
        self.parts.pings.tick()
        self.parts.shadow.tick()

    def _tick_until_stop(self) -> None:
        parts = self.parts
        measured = looked = repeated = parts.clock.monotonic()
        parts.accounts.tell()
        while not parts.clock.wait(self._stop, _TICK_S):
            self.tick()
            now = parts.clock.monotonic()
            if now - looked >= _RATES_S:
                looked = now
                parts.rates.update(parts.streams.counts())
            parts.accounts.tick()
            if now - repeated >= _TYPES_S:
                repeated = now
                parts.streams.repeat_types()
            if parts.config.metrics.enabled and now - measured >= parts.config.metrics.every_s:
                measured = now
                self._measure()

    def _measure(self) -> None:
        """Record a sample of the agent's own stream."""
        parts = self.parts
        samples = sum(
            counts.samples for name, counts in parts.streams.counts().items() if name not in OWN_STREAMS
        )
        parts.streams.record(AGENT_STREAM, parts.clock.now_us(), parts.metrics.sample(samples))

    def _start_source(self, i: int, source: SourceRun) -> threading.Thread:
        emit: Emit = self.parts.streams.emit
        attachments = self.parts.attachments
        if attachments is not None:
            emit = attachments.around(emit)
        return _start(f"source {i}", lambda: source.run(emit, self._stop))

    def _stop_after(self, sources: Sequence[threading.Thread]) -> None:
        for thread in sources:
            thread.join()
        self._stop.set()

    def _check_sources(self) -> None:
        found = self.parts.streams.counts()
        for source in self.parts.sources:
            counts = [found[name] for name in source.streams if name in found]
            source.check_stored([(one.samples, one.refused) for one in counts])

    def _drain(self, drain_s: float) -> bool:
        """Whether everything was delivered, or is kept for the next run."""
        streams, spool = self.parts.streams, self.parts.spool
        streams.flush()
        # After the flush, so that the accounts count every batch; theirs is the last one.
        self.parts.accounts.tell(ended=True)
        streams.flush()
        left = spool.backlog()
        if left.batches:
            _log.info("delivering the last %d batches", left.batches)
        if self.parts.record.wait_empty(drain_s):
            dropped = spool.dropped()
            if dropped.batches:
                _log.error("%d samples were dropped: the queue was full, or damaged", dropped.samples)
            return dropped.batches == 0
        left = spool.backlog()
        if spool.durable:
            _log.warning(
                "%d samples in %d batches were not delivered within %g s; the next run sends them",
                left.samples, left.batches, drain_s,
            )  # fmt: skip
            return True
        _log.error(
            "%d samples in %d batches could not be delivered within %g s and are lost",
            left.samples, left.batches, drain_s,
        )  # fmt: skip
        return False

    def _end_uploads(self, thread: threading.Thread | None, stop: threading.Event, drain_s: float) -> None:
        """Upload the attachments, as they belong to samples; the next run uploads a folder's other files."""
        attachments, uploads = self.parts.attachments, self.parts.uploads
        if attachments is not None and not attachments.wait_empty(drain_s):
            _log.warning("contents were not uploaded within %g s; the next run uploads them", drain_s)
        stop.set()
        if uploads is not None:
            uploads.wake()
        if thread is not None:
            thread.join()


def _start(name: str, target: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=target, name=name, daemon=True)
    thread.start()
    return thread
