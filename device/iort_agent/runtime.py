"""One run of the agent: its connection, its threads, what they do in turn, and the order of their ends."""

from __future__ import annotations

import logging
import math
import threading
from typing import Callable

from iort_agent.agent import Agent
from iort_agent.common.threads import WATCH, Clock, Supervised
from iort_agent.config import Config
from iort_agent.lanes.record import TODO, too_many
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import Uplink
from iort_agent.sources import Emit
from iort_agent.sources.registry import SourceRun
from iort_contract.catalog.streams import AGENT_STREAM, LOG_STREAM, OWN_STREAMS

_log = logging.getLogger(__name__)

# The longest delay of a silent stream's last live sample, and the shortest wait for its last batch. What can
# wait is looked at once a second: each part that is woken from a cold cache costs as much as ten samples.
_TICK_S, _LEAST_S, _SLOW_S = 0.5, 0.1, 1.0
_TYPES_S = 3600.0
_CLOSE_S = 5.0
# A warm Lambda function answers well within this time.
_LAST_PONGS_S = 2.0
_LOOK_S = 0.5


def make_uplink(config: Config, clock: Clock) -> Uplink:
    """The connection of a robot's configuration."""
    # Reading a configuration must not need the network's library.
    from iort_agent.mqtt.aws import IotCore  # noqa: PLC0415 - it loads the library
    from iort_agent.mqtt.client import Broker  # noqa: PLC0415 - as above

    broker = Broker(
        config.endpoint, config.port, config.robot, config.certificate, config.private_key, config.root_ca
    )
    return IotCore(broker, clock=clock, dispatcher=Dispatcher())


class Runtime:
    """Runs an agent. `run` is called once.

    ``stopped_s`` is the time for delivering the rest after a stop from outside, because a service manager
    kills what takes long; while the rest takes longer, its progress is logged every ``progress_s``.
    """

    def __init__(self, agent: Agent, *, stopped_s: float = 10.0, progress_s: float = 5.0) -> None:
        self.agent = agent
        self._stopped_s, self._progress_s = stopped_s, progress_s
        self._stop = threading.Event()
        self._asked = self._broken = False
        self._lock = threading.Lock()
        self._running = len(agent.sources)
        self._measured = self._repeated = agent.clock.monotonic()

    def stop(self) -> None:
        """End the run in good order; may be called from any thread and from a signal handler."""
        self._asked = True
        self._end_all()

    def run(self, *, drain_s: float | None) -> int:
        """Run until every source has ended or `stop` is called, then deliver the rest within ``drain_s``.

        None means: however long it takes if the sources ended by themselves, and ``stopped_s`` once `stop` is
        called. Returns the exit status: 1 if a source failed or ended without a stored sample, if a batch
        was dropped, if not all was delivered, or if a thread failed for good; else 0. A run that was stopped
        may leave batches to the next one, in a queue on disk. Raises `UplinkError` if the uplink cannot
        start.
        """
        agent = self.agent
        problem = too_many(agent.config.sources, agent.config.record)
        if problem is not None:
            _log.warning("record: %s; %s", problem, TODO)
        WATCH.on_end(self._end)
        agent.uplink.start()
        if agent.downlink is not None:
            agent.downlink.start()
        record_stop, uploads_stop = threading.Event(), threading.Event()
        record = Supervised("record", lambda: agent.record.run(record_stop))
        ticker = Supervised("ticker", self._tick_until_stop)
        pinger = Supervised("pings", lambda: agent.pings.run(self._stop))
        sources = [self._thread_of(i, source) for i, source in enumerate(agent.sources)]
        uploads = agent.uploads
        uploader = None if uploads is None else Supervised("uploads", lambda: uploads.run(uploads_stop))
        if agent.recorder is not None:
            agent.recorder.start()
        if agent.video is not None:
            agent.video.start()
        for thread in (record, ticker, *sources, pinger, *([uploader] if uploader is not None else [])):
            thread.start()
        if sources:
            self._stop.wait()
        self._end_all()
        stopped = self._asked or self._broken
        if agent.downlink is not None:
            # An agent that ends by itself must not end an emergency stop.
            agent.downlink.halt(keep_stop=not self._asked)
        agent.pings.wake()
        if agent.video is not None:
            agent.video.close()
        for thread in (*sources, ticker, pinger):
            thread.join()
        uploaded = bool(sources) or self._end_incidents(drain_s)
        if agent.recorder is not None:
            agent.recorder.close()
        agent.pings.close(_LAST_PONGS_S if drain_s is None else min(_LAST_PONGS_S, drain_s))
        agent.streams.flush()
        self._check_sources()
        self._send_log()
        delivered = self._drain(drain_s, stopped=stopped) and uploaded
        if agent.downlink is not None:
            agent.downlink.close(keep_stop=not self._asked)
        delivered = self._end_uploads(uploader, uploads_stop, drain_s, stopped=stopped) and delivered
        record_stop.set()
        agent.record.wake()
        record.join()
        agent.uplink.stop(_CLOSE_S)
        failed = self._broken or any(source.failed for source in agent.sources)
        return 0 if delivered and not failed else 1

    def tick(self) -> float:
        """Do what is due of what cannot wait. Return when the next is due: when a silent stream's batch is to
        be closed; at once while the shadow is fetched, so that a short run reports itself too."""
        closes_at = self.agent.streams.tick()
        self.agent.record.tick()
        self.agent.live.tick()
        self.agent.shadow.tick()
        return -math.inf if self.agent.shadow.fetching() else closes_at

    def tick_slowly(self) -> None:
        """Do what else is due; `run` calls it once a second."""
        agent, metrics, now = self.agent, self.agent.config.metrics, self.agent.clock.monotonic()
        self._send_log()
        agent.viewers.tick()
        agent.pings.tick()
        agent.stop_file.tick()
        agent.rates.update(agent.streams.counts())
        agent.accounts.tick()
        if now - self._repeated >= _TYPES_S:
            self._repeated = now
            agent.streams.repeat_types()
        if metrics.enabled and now - self._measured >= metrics.every_s:
            self._measured = now
            self._measure()

    def _tick_until_stop(self) -> None:
        clock = self.agent.clock
        slow_at = self._measured = self._repeated = clock.monotonic()
        self.agent.accounts.tell()
        wait_s, ticked_at, changed = _TICK_S, -math.inf, self.agent.shadow.changed
        while not self._stop.is_set():
            if clock.wait(changed, wait_s):
                changed.clear()
                if clock.wait(self._stop, max(0.0, ticked_at + _LEAST_S - clock.monotonic())):
                    return
            closes_at, now = self.tick(), clock.monotonic()
            ticked_at = now
            wait_s = min(_TICK_S, max(_LEAST_S, closes_at - now))
            if now >= slow_at:
                slow_at = now + _SLOW_S - _TICK_S / 2
                self.tick_slowly()

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

    def _end(self) -> None:
        """End the run in good order, and with status 1: a thread has failed for good."""
        self._broken = True
        self._end_all()

    def _end_all(self) -> None:
        self._stop.set()
        # The ticker waits for this one.
        self.agent.shadow.changed.set()

    def _thread_of(self, i: int, source: SourceRun) -> Supervised:
        emit: Emit = self.agent.streams.emit
        if self.agent.attachments is not None:
            emit = self.agent.attachments.around(emit)
        if self.agent.recorder is not None:
            # First, so that the ring has the messages as they were published.
            emit = self.agent.recorder.around(emit, source.only_ring)
        return Supervised("source", lambda: self._run_source(source, emit), title=str(i))

    def _run_source(self, source: SourceRun, emit: Emit) -> None:
        source.run(emit, self._stop)
        with self._lock:
            self._running -= 1
            if not self._running:
                self._end_all()

    def _check_sources(self) -> None:
        streams = self.agent.streams.counts()
        for source in self.agent.sources:
            counts = [streams[name] for name in source.streams if name in streams]
            source.check_stored([(count.samples, count.refused) for count in counts])

    def _drain(self, drain_s: float | None, *, stopped: bool) -> bool:
        """Deliver the rest; whether all was delivered, or is kept for the run after a stopped one."""
        streams, spool = self.agent.streams, self.agent.spool
        streams.flush()
        # After the flush, so that the accounts count every batch. Their own batch is the last one.
        self.agent.accounts.tell(ended=True)
        streams.flush()
        left = spool.backlog()
        if left.batches:
            _log.info("delivering the last %d batches", left.batches)
        if self._wait(self.agent.record.wait_empty, drain_s, self._tell_left):
            dropped = spool.dropped()
            if dropped.batches:
                _log.error("%d samples were dropped: the queue was full or damaged", dropped.samples)
            return dropped.batches == 0
        left = spool.backlog()
        rest = f"{left.samples} samples in {left.batches} batches were not delivered"
        if not spool.durable:
            _log.error("%s and are lost: the queue's disk does not work", rest)
        elif stopped:
            _log.warning("%s; the next run sends them, or `iort-agent flush`", rest)
        else:
            # The next run would play a recording again.
            _log.error("%s; they are in the queue: `iort-agent flush` sends them", rest)
        return spool.durable and stopped

    def _wait(self, empty: Callable[[float], bool], drain_s: float | None, tell: Callable[[], None]) -> bool:
        """Wait until ``empty``, as `run` says of ``drain_s``; whether it is. ``tell`` logs the progress."""
        waited = logged = 0.0
        while True:
            if drain_s is None and (self._asked or self._broken):
                drain_s = waited + self._stopped_s
            look_s = _LOOK_S if drain_s is None else max(0.0, min(_LOOK_S, drain_s - waited))
            if empty(look_s):
                return True
            waited += look_s
            if drain_s is not None and waited >= drain_s:
                return False
            if waited - logged >= self._progress_s:
                logged = waited
                tell()

    def _end_incidents(self, drain_s: float | None) -> bool:
        """Upload what earlier runs have kept of events; whether nothing is left."""
        recorder = self.agent.recorder
        if recorder is None:
            return self.agent.no_recorder is None

        def tell(log: Callable[..., None] = _log.info) -> None:
            left = recorder.incidents.waiting()
            log("%d incidents are still to be cut, and %d to be uploaded", left["open"], left["waiting"])

        if self._wait(recorder.incidents.wait_empty, drain_s, tell):
            return True
        tell(_log.error)
        return False

    def _tell_left(self) -> None:
        left, connection = self.agent.spool.backlog(), self.agent.uplink.status()
        why = "" if connection.connected else f"; not connected: {connection.last_error or 'no answer'}"
        _log.info("%d samples in %d batches are still to be delivered%s", left.samples, left.batches, why)

    def _end_uploads(
        self,
        thread: Supervised | None,
        stop: threading.Event,
        drain_s: float | None,
        *,
        stopped: bool,
    ) -> bool:
        """Upload the attachments, which belong to samples, and return whether they are, or are kept for the
        run after a stopped one. The next run uploads the other files."""
        attachments, uploads = self.agent.attachments, self.agent.uploads
        uploaded = attachments is None or self._wait(attachments.wait_empty, drain_s, _tell_uploading)
        if not uploaded:
            _log.warning("attachments were not uploaded; the next run uploads them, or `iort-agent flush`")
        stop.set()
        if uploads is not None:
            uploads.wake()
        if thread is not None:
            thread.join()
        return uploaded or stopped


def _tell_uploading() -> None:
    _log.info("attachments are still to be uploaded")
