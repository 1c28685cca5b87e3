"""The agent: sources, batches, spool, lanes, pings and the shadow around one uplink, from start to
clean end."""

from __future__ import annotations

import logging
import os
import threading
import uuid
from typing import Any, Mapping

import iort_contract
from iort_agent.account import Accounts
from iort_agent.clock import Clock
from iort_agent.config.file import Config
from iort_agent.control.downlink import make_downlink
from iort_agent.control.runtime_settings import Tuning, configured
from iort_agent.control.shadow import Remote
from iort_agent.errors import SourceError
from iort_agent.files.folder import make_uploads
from iort_agent.lanes.attachment import make_claims
from iort_agent.lanes.batch import Batcher, StreamCounts
from iort_agent.lanes.batch_encoder import Packer
from iort_agent.lanes.clock_offset import ClockOffset
from iort_agent.lanes.live import LiveLane
from iort_agent.lanes.pings import Pings
from iort_agent.lanes.record import TODO, RecordLane, too_many
from iort_agent.logs import Troubles, set_level
from iort_agent.metrics import AgentMetrics, Rates
from iort_agent.mqtt.uplink import Uplink
from iort_agent.rate_limiter import Allowance
from iort_agent.sources import Source
from iort_agent.spool.memory import Spool
from iort_agent.version import agent_version
from iort_contract import Value

_log = logging.getLogger(__name__)

# What a tick may be late by: the last sample of a stream that falls silent, live, and its batch.
_TICK_S = 0.2
_RATES_S = 1.0
# How often types are said again, and of how many.
_TYPES_S, _MOST_TYPES = 3600.0, 1024
_CLOSE_S = 5.0
# A Lambda function that is warm answers well within this.
_LAST_PONGS_S = 2.0


class Agent:
    """One run of the agent. `run` is called once."""

    def __init__(
        self,
        config: Config,
        *,
        uplink: Uplink,
        spool: Spool,
        clock: Clock,
        troubles: Troubles | None = None,
    ) -> None:
        self.boot = uuid.uuid4().hex[:16]
        self._config = config
        self._uplink = uplink
        self._spool = spool
        self._clock = clock
        self._troubles = troubles
        self._began = clock.monotonic()
        allowance = Allowance(clock)
        names = {"robot": config.robot, "namespace": config.namespace}
        shared: dict[str, Any] = {**names, "uplink": uplink, "clock": clock, "allowance": allowance}
        self._record = RecordLane(spool=spool, **shared)
        self._offset = ClockOffset(clock)
        self._live = LiveLane(
            boot=self.boot, rate_hz=config.live.rate_hz, offset_us=self._offset.known_us, **shared
        )
        ping = config.ping
        self._pings = Pings(
            paths=ping.paths,
            rate_hz=ping.rate_hz,
            padding_bytes=ping.padding_bytes,
            emit=self.record,
            on_stamp=self._offset.add,
            **shared,
        )
        self._tuning = configured(
            record=config.record, live=config.live, ping=config.ping, log_level=config.log_level
        )
        self._remote = Remote(
            robot=config.robot,
            base=self._tuning,
            apply=self.tune,
            known_fields=lambda: dict(self._fields),
            version=agent_version(),
            uplink=uplink,
            clock=clock,
            allowance=allowance,
        )
        self._downlink = make_downlink(
            config.downlink,
            config.share,
            sources=config.sources,
            boot=self.boot,
            offset=self._offset.known,
            answer=self._remote.answer,
            **shared,
        )
        self._uploads = make_uploads(config.files, root_ca=config.root_ca, **shared)
        self._claims = make_claims(config.files, robot=config.robot, clock=clock, uploads=self._uploads)
        self._lock = threading.Lock()
        self._batchers: dict[str, Batcher] = {}
        self._counts: dict[str, StreamCounts] = {}
        # What sources have said of their messages' types, under lock.
        self._types: dict[tuple[Value, ...], Mapping[str, Value]] = {}
        self._fields: dict[str, Any] = {}
        self._failed: list[str] = []
        self._ended: list[int] = []
        self._sources = [(source.describe(), source.build(clock)) for source in config.sources]
        self._stop = threading.Event()
        self._rates = Rates(clock)
        self._metrics = AgentMetrics(
            clock=clock, spool=spool, uplink=uplink, offset=self._offset, uploads=self._uploads
        )
        self._accounts = Accounts(
            clock=clock,
            spool=spool,
            streams=[stream for source in config.sources for stream in source.streams()],
            counted=self._counted,
            refused=lambda: sum(counts.refused for counts in self._counts.copy().values()),
            reports=[
                # Two sources may be described alike.
                *((f"{i}: {what}", source.report) for i, (what, source) in enumerate(self._sources)),
                *([("contents", self._claims.report)] if self._claims is not None else []),
            ],
            emit=self.record,
        )
        self.tune(self._tuning)

    def stop(self) -> None:
        """Ask the agent to end in good order; from any thread, or a signal handler."""
        self._stop.set()

    def tune(self, tuning: Tuning) -> None:
        """Bring other settings into force, at once and from any thread."""
        if tuning.log_level != self._tuning.log_level:
            set_level(tuning.log_level)
        self._live.enabled = tuning.live_enabled
        self._live.set_rate(tuning.live_rate_hz)
        self._pings.set_rate(tuning.ping_rate_hz)
        again = tuning.record_enabled and not self._tuning.record_enabled
        self._tuning = tuning
        if again:
            self._say_types()

    def emit(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample from a source, for both lanes. The live lane first: it is the one in a hurry."""
        if stream == iort_contract.TYPES_STREAM:
            # What a message is made of is nothing to look at live.
            with self._lock:
                self._types[tuple(values.get(name) for name in ("stream", "topic", "kind", "md5sum"))] = (
                    values
                )
                if len(self._types) > _MOST_TYPES:
                    del self._types[next(iter(self._types))]
            self.record(stream, t_us, values)
            return
        if self._tuning.fields and stream in self._tuning.fields:
            self._fields.setdefault(stream, values.keys())
            values = {name: values[name] for name in self._tuning.fields[stream] if name in values}
        self._live.offer(stream, t_us, values)
        self.record(stream, t_us, values)

    def record(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """Take a sample for the record lane alone."""
        batcher = self._batchers.get(stream)
        if batcher is None:
            batcher = self._new_batcher(stream, values)
        if self._tuning.record_enabled:
            batcher.add(t_us, values)

    def run(self, *, drain_s: float) -> int:
        """Run until every source has ended or `stop` is called, then deliver what is left.

        Returns the exit status: 0, or 1 if a source failed or ended without anything that could be stored,
        or a batch could not be delivered within ``drain_s``. Raises `UplinkError` where the uplink cannot
        start at all.
        """
        problem = too_many(self._config.sources, self._config.record)
        if problem is not None:
            _log.warning("record: %s; %s", problem, TODO)
        self._uplink.start()
        if self._downlink is not None:
            self._downlink.start()
        record_stop = threading.Event()
        lane = self._thread("record", lambda: self._record.run(record_stop))
        ticker = self._thread("ticker", self._tick)
        sources = [
            self._thread(f"source {i}", self._source(i, what, source))
            for i, (what, source) in enumerate(self._sources)
        ]
        watcher = self._thread("watcher", lambda: self._end_with(sources))
        pinger = self._thread("pings", lambda: self._pings.run(self._stop))
        uploads_stop = threading.Event()
        uploader = self._thread("uploads", self._run_uploads(uploads_stop))
        self._stop.wait()
        if self._downlink is not None:
            self._downlink.halt()
        self._pings.wake()
        for thread in (*sources, watcher, ticker, pinger):
            thread.join()
        self._pings.close(min(_LAST_PONGS_S, drain_s))
        delivered = self._drain(drain_s)
        self._fail_without_samples()
        if self._downlink is not None:
            self._downlink.close()
        self._end_uploads(uploads_stop, drain_s)
        uploader.join()
        record_stop.set()
        self._record.wake()
        lane.join()
        self._uplink.stop(_CLOSE_S)
        return 0 if delivered and not self._failed else 1

    def tick(self) -> None:
        """Look around in batches and lanes; `run` does it several times a second."""
        for batcher in list(self._batchers.values()):
            batcher.tick()
        self._record.tick()
        self._live.tick()
        self._pings.tick()
        self._remote.tick()

    def report(self) -> dict[str, Any]:
        """What became of everything, for a file or a test."""
        left, dropped = self._spool.backlog(), self._spool.dropped()
        pings = self._pings.report() if self._tuning.ping_rate_hz else {}
        return {
            "robot": self._config.robot,
            "boot": self.boot,
            "streams": {name: vars(counts).copy() for name, counts in sorted(self._counts.items())},
            "live_published": self._live.published,
            "live_refused": self._live.refused,
            "live": {**self._live.tempo._asdict(), "streams_hz": self._live.rates_hz()},
            "spool": {
                "left_batches": left.batches,
                "left_samples": left.samples,
                "dropped_batches": dropped.batches,
                "dropped_samples": dropped.samples,
            },
            "pings": {path: report._asdict() for path, report in pings.items()},
            "failed_sources": list(self._failed),
            "sources": [{"source": what, **source.report()} for what, source in self._sources],
            **({"downlink": self._downlink.report()} if self._downlink is not None else {}),
            **({"files": self._files_status()} if self._uploads is not None else {}),
        }

    def status(self) -> dict[str, Any]:
        """How it goes right now, for `iort-agent status`."""
        uplink, backlog, dropped = self._uplink.status(), self._spool.backlog(), self._spool.dropped()
        tuning, offset = self._tuning, self._offset.estimate()
        tempo, live_hz = self._live.tempo, self._live.rates_hz()
        alarms = [alarm for alarm in (self._spool.alarm, self._record.alarm) if alarm]
        alarms += [f"source failed: {what}" for what in self._failed]
        alarms += [f"source waits: {why}" for why in self._waits()]
        return {
            "robot": self._config.robot,
            "boot": self.boot,
            "pid": os.getpid(),
            "uptime_s": round(self._clock.monotonic() - self._began, 1),
            "connection": {
                **uplink._asdict(),
                "endpoint": f"{self._config.endpoint}:{self._config.port}",
            },
            "lanes": {
                "record": {"enabled": tuning.record_enabled},
                "live": {
                    "enabled": tuning.live_enabled,
                    "rate_hz": tuning.live_rate_hz,
                    "effective_hz": tempo.effective_hz,
                    "slowed": tempo.slowed,
                    "published": self._live.published,
                    "refused": self._live.refused,
                },
                "ping": {"rate_hz": tuning.ping_rate_hz, "held_back": self._pings.held_back},
            },
            "sources": [{"source": what, **source.report()} for what, source in self._sources],
            "streams": {
                name: {
                    **vars(counts),
                    "per_s": self._rates.per_s.get(name, 0.0),
                    "live_hz": live_hz.get(name, 0.0),
                    "silent_s": self._rates.silent_s(name),
                    "fields": list(tuning.fields.get(name, ())),
                }
                for name, counts in sorted(self._counts.copy().items())
            },
            "spool": {
                "batches": backlog.batches,
                "samples": backlog.samples,
                "bytes": backlog.payload_bytes,
                "dropped_batches": dropped.batches,
                "dropped_samples": dropped.samples,
            },
            "files": self._files_status() if self._uploads is not None else None,
            "clock": offset._asdict() if offset is not None else None,
            "pings": {path: report._asdict() for path, report in self._pings.report().items()},
            "over_share": self._remote.over_share,
            "alarms": alarms,
            "troubles": self._troubles.last() if self._troubles is not None else [],
        }

    def _waits(self) -> list[str]:
        """What sources and commands wait for, each said once: they may share a ROS node."""
        found = [source.report().get("waits") for _, source in self._sources]
        if self._downlink is not None:
            found.append(self._downlink.report()["waits"])
        return [str(why) for why in dict.fromkeys(found) if why]

    def _new_batcher(self, stream: str, values: Mapping[str, Value]) -> Batcher:
        with self._lock:
            if stream not in self._batchers:
                iort_contract.check_stream(stream)
                self._fields.setdefault(stream, values.keys())
                counts = self._counts[stream] = StreamCounts(first_seq=self._spool.next_seq(stream))
                packer = Packer(
                    stream=stream,
                    boot=self.boot,
                    spool=self._spool,
                    counts=counts,
                )
                self._batchers[stream] = Batcher(
                    packer.store, batch_s=self._config.record.batch_s, clock=self._clock, counts=counts
                )
            return self._batchers[stream]

    def _source(self, i: int, what: str, source: Source) -> Any:
        def run() -> None:
            _log.info("source started: %s", what)
            try:
                source.run(self.emit if self._claims is None else self._claims.around(self.emit), self._stop)
            except SourceError as error:
                _log.error("source failed: %s: %s", what, error)
                self._failed.append(what)
            except Exception:  # noqa: BLE001 - whatever a driver raises
                # The other sources must go on.
                _log.exception("source failed: %s", what)
                self._failed.append(what)
            else:
                _log.info("source ended: %s", what)
                if not self._stop.is_set():
                    self._ended.append(i)

        return run

    def _fail_without_samples(self) -> None:
        """A source that ended by itself, and of which nothing could be stored, has failed."""
        for i in self._ended:
            what = self._sources[i][0]
            streams = self._config.sources[i].streams()
            counts = [self._counts[name] for name in streams if name in self._counts]
            samples, refused = sum(one.samples for one in counts), sum(one.refused for one in counts)
            if not counts:
                _log.error("source failed: %s: it gave no sample", what)
            elif samples and samples == refused:
                _log.error("source failed: %s: none of its %d samples could be stored", what, samples)
            else:
                continue
            self._failed.append(what)

    def _run_uploads(self, stop: threading.Event) -> Any:
        uploads = self._uploads
        return (lambda: uploads.run(stop)) if uploads is not None else (lambda: None)

    def _end_uploads(self, stop: threading.Event, drain_s: float) -> None:
        """Contents of samples are delivered like samples; a folder's files wait for the next run."""
        if self._claims is not None and not self._claims.wait_empty(drain_s):
            _log.warning("contents were not uploaded within %g s; the next run uploads them", drain_s)
        stop.set()
        if self._uploads is not None:
            self._uploads.wake()

    def _files_status(self) -> dict[str, Any]:
        uploads = self._uploads.status() if self._uploads is not None else {}
        return {**uploads, "large": self._claims.report() if self._claims is not None else None}

    def _end_with(self, sources: list[threading.Thread]) -> None:
        for thread in sources:
            thread.join()
        self._stop.set()

    def _tick(self) -> None:
        measured = looked = said = self._clock.monotonic()
        self._accounts.tell()
        while not self._clock.wait(self._stop, _TICK_S):
            self.tick()
            now = self._clock.monotonic()
            if now - looked >= _RATES_S:
                looked = now
                self._rates.update(self._counts.copy())
            self._accounts.tick()
            if now - said >= _TYPES_S:
                said = now
                self._say_types()
            if self._config.metrics.enabled and now - measured >= self._config.metrics.every_s:
                measured = now
                self._measure()

    def _counted(self) -> dict[str, tuple[StreamCounts, int]]:
        found = {name: batcher.counts() for name, batcher in list(self._batchers.items())}
        # Not the spool's number of this moment, which may be a batch further than the counts.
        return {name: (counts, counts.first_seq + counts.batches) for name, counts in found.items()}

    def _say_types(self) -> None:
        """Say once more what messages are made of. Batches of columns need it to become messages again, and
        what was said before may have been dropped by the queue, or expired, or never recorded."""
        with self._lock:
            said = list(self._types.values())
        for values in said:
            self.record(iort_contract.TYPES_STREAM, self._clock.now_us(), values)

    def _measure(self) -> None:
        """A sample of the agent's own stream."""
        counts = self._counts.copy()
        samples = sum(c.samples for name, c in counts.items() if name not in iort_contract.OWN_STREAMS)
        self.record(iort_contract.AGENT_STREAM, self._clock.now_us(), self._metrics.sample(samples))

    def _flush(self) -> None:
        for batcher in list(self._batchers.values()):
            batcher.flush()

    def _drain(self, drain_s: float) -> bool:
        self._flush()
        # Once every batch is closed, so that nothing is left open but its own.
        self._accounts.tell(ended=True)
        self._flush()
        left = self._spool.backlog()
        if left.batches:
            _log.info("delivering the last %d batches", left.batches)
        if self._record.wait_empty(drain_s):
            dropped = self._spool.dropped()
            if dropped.batches:
                _log.error("%d samples were dropped: the queue was full, or damaged", dropped.samples)
            return dropped.batches == 0
        left = self._spool.backlog()
        if self._spool.durable:
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

    @staticmethod
    def _thread(name: str, target: Any) -> threading.Thread:
        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        return thread
