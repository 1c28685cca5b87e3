"""One run of the agent: its threads, what they do in turn, and the order in which they end."""

from __future__ import annotations

import logging
import threading
from typing import Callable, Sequence

from iort_agent.agent import Agent
from iort_agent.lanes.record import TODO, too_many
from iort_agent.sources import Emit
from iort_agent.sources.run import SourceRun
from iort_contract.catalog.streams import AGENT_STREAM, LOG_STREAM, OWN_STREAMS

_log = logging.getLogger(__name__)

# The longest delay of a silent stream's last live sample and last batch.
_TICK_S = 0.2
_RATES_S = 1.0
_TYPES_S = 3600.0
_CLOSE_S = 5.0
# A warm Lambda function answers well within this time.
_LAST_PONGS_S = 2.0


class Runtime:
    """Runs an agent. `run` is called once."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self._stop = threading.Event()
        self._asked = False

    def stop(self) -> None:
        """End the run in good order; may be called from any thread and from a signal handler."""
        self._asked = True
        self._stop.set()

    def run(self, *, drain_s: float) -> int:
        """Run until every source has ended or `stop` is called, then deliver the rest.

        Returns the exit status: 1 if a source failed or ended without a stored sample, or if a batch was
        dropped or could not be delivered within ``drain_s``; else 0. Raises `UplinkError` if the uplink
        cannot start.
        """
        agent = self.agent
        problem = too_many(agent.config.sources, agent.config.record)
        if problem is not None:
            _log.warning("record: %s; %s", problem, TODO)
        agent.uplink.start()
        if agent.downlink is not None:
            agent.downlink.start()
        record_stop, uploads_stop = threading.Event(), threading.Event()
        record = _start("record", lambda: agent.record.run(record_stop))
        ticker = _start("ticker", self._tick_until_stop)
        sources = [self._start_source(i, source) for i, source in enumerate(agent.sources)]
        watcher = _start("watcher", lambda: self._stop_after(sources))
        pinger = _start("pings", lambda: agent.pings.run(self._stop))
        uploads = agent.uploads
        uploader = None if uploads is None else _start("uploads", lambda: uploads.run(uploads_stop))
        self._stop.wait()
        if agent.downlink is not None:
            # An agent that ends by itself must not end an emergency stop.
            agent.downlink.halt(keep_stop=not self._asked)
        agent.pings.wake()
        for thread in (*sources, watcher, ticker, pinger):
            thread.join()
        agent.pings.close(min(_LAST_PONGS_S, drain_s))
        agent.streams.flush()
        self._check_sources()
        self._send_log()
        delivered = self._drain(drain_s)
        if agent.downlink is not None:
            agent.downlink.close(keep_stop=not self._asked)
        self._end_uploads(uploader, uploads_stop, drain_s)
        record_stop.set()
        agent.record.wake()
        record.join()
        agent.uplink.stop(_CLOSE_S)
        return 0 if delivered and not any(source.failed for source in agent.sources) else 1

    def tick(self) -> None:
        """Let streams and lanes do what is due; `run` calls it several times a second."""
        self._send_log()
        self.agent.streams.tick()
        self.agent.record.tick()
        self.agent.viewers.tick()
        self.agent.live.tick()
        self.agent.pings.tick()
        self.agent.shadow.tick()
        self.agent.kept_stop.tick()

    def _tick_until_stop(self) -> None:
        agent, metrics = self.agent, self.agent.config.metrics
        measured = rated = repeated = agent.clock.monotonic()
        agent.accounts.tell()
        while not agent.clock.wait(self._stop, _TICK_S):
            self.tick()
            now = agent.clock.monotonic()
            if now - rated >= _RATES_S:
                rated = now
                agent.rates.update(agent.streams.counts())
            agent.accounts.tick()
            if now - repeated >= _TYPES_S:
                repeated = now
                agent.streams.repeat_types()
            if metrics.enabled and now - measured >= metrics.every_s:
                measured = now
                self._measure()

    def _send_log(self) -> None:
        """Emit the agent's own warnings and errors. Where they are logged, a lane's lock may be held."""
        troubles = self.agent.troubles
        for t_us, line in troubles.lines.take() if troubles is not None else ():
            self.agent.streams.emit(LOG_STREAM, t_us, line)

    def _measure(self) -> None:
        """Record a sample of the agent's own stream."""
        streams, own = self.agent.streams, OWN_STREAMS
        samples = sum(counts.samples for name, counts in streams.counts().items() if name not in own)
        sample = self.agent.metrics.sample(samples)
        streams.record(AGENT_STREAM, self.agent.clock.now_us(), sample)

    def _start_source(self, i: int, source: SourceRun) -> threading.Thread:
        emit: Emit = self.agent.streams.emit
        if self.agent.attachments is not None:
            emit = self.agent.attachments.around(emit)
        return _start(f"source {i}", lambda: source.run(emit, self._stop))

    def _stop_after(self, sources: Sequence[threading.Thread]) -> None:
        for thread in sources:
            thread.join()
        self._stop.set()

    def _check_sources(self) -> None:
        found = self.agent.streams.counts()
        for source in self.agent.sources:
            counts = [found[name] for name in source.streams if name in found]
            source.check_stored([(one.samples, one.refused) for one in counts])

    def _drain(self, drain_s: float) -> bool:
        """Deliver the rest; whether all was delivered, or is kept for the next run."""
        streams, spool = self.agent.streams, self.agent.spool
        streams.flush()
        # After the flush, so that the accounts count every batch. Their own batch is the last one.
        self.agent.accounts.tell(ended=True)
        streams.flush()
        left = spool.backlog()
        if left.batches:
            _log.info("delivering the last %d batches", left.batches)
        if self.agent.record.wait_empty(drain_s):
            dropped = spool.dropped()
            if dropped.batches:
                _log.error("%d samples were dropped: the queue was full or damaged", dropped.samples)
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
        """Upload the attachments, which belong to samples. The next run uploads the other files."""
        attachments, uploads = self.agent.attachments, self.agent.uploads
        if attachments is not None and not attachments.wait_empty(drain_s):
            _log.warning("attachments were not uploaded within %g s; the next run uploads them", drain_s)
        stop.set()
        if uploads is not None:
            uploads.wake()
        if thread is not None:
            thread.join()


def _start(name: str, target: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=target, name=name, daemon=True)
    thread.start()
    return thread
