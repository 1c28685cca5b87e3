"""The agent's figures about itself, as samples of streams like any other: what it uses (`agent`), and what it
took, stored and did not record (`account`), which `iort audit` compares with the table.
"""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Sequence, Tuple

from iort_agent.common.schema import flag, number, setting
from iort_agent.common.threads import WATCH, Clock
from iort_agent.files.folder import Uploads
from iort_agent.lanes.pings import OffsetEstimator
from iort_agent.lanes.streams import StreamCounts, Streams
from iort_agent.mqtt.uplink import Uplink
from iort_agent.spool import Spool
from iort_contract.catalog.streams import ACCOUNT_STREAM, AGENT_FIELDS
from iort_contract.limits import Value
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount

# A loss is reported within a second.
_LOSS_S = 1.0
# Counts of what was taken, not of losses.
_TAKEN = frozenset({"messages", "samples", "rows", "opened", "silent", "kept", "published"})

# A source's name, and a function that returns its counts.
Reports = Sequence[Tuple[str, Callable[[], Mapping[str, Any]]]]
_STATM = Path("/proc/self/statm")


class Accounts:
    """Emits the accounts of every stream and every source. ``expected`` are the streams of the sources;
    ``replayed`` tells whether a stream's times pass at another speed than the clock's."""

    def __init__(
        self,
        *,
        clock: Clock,
        spool: Spool,
        streams: Streams,
        expected: Sequence[str],
        replayed: Callable[[str], bool],
        reports: Reports,
    ) -> None:
        self._clock, self._spool, self._streams = clock, spool, streams
        self._expected, self._replayed, self._reports = expected, replayed, reports
        self._told = clock.monotonic()
        self._lost = 0

    def tick(self) -> None:
        """Report if it is time; called several times a second."""
        passed = self._clock.monotonic() - self._told
        if passed >= ACCOUNT_EVERY_S or (passed >= _LOSS_S and self._losses() != self._lost):
            self.tell()

    def tell(self, *, ended: bool = False) -> None:
        """Emit a sample for each stream and each source. The last one says ``ended``; it comes after every
        batch is closed."""
        self._told, self._lost = self._clock.monotonic(), self._losses()
        now_us = self._clock.now_us()
        counted = self._streams.counts()
        for name in sorted({*self._expected, *counted} - {ACCOUNT_STREAM}):
            counts = counted.get(name, StreamCounts())
            account = StreamAccount(
                stream=name,
                taken=counts.samples,
                stored=counts.stored,
                refused=counts.refused,
                nulled=counts.nulled,
                first_seq=0,
                next_seq=counts.batches,
                ended=ended,
                durable=self._spool.durable,
                replayed=self._replayed(name),
            )
            self._streams.record(ACCOUNT_STREAM, now_us, account.sample())
        dropped = self._spool.dropped()
        queue = {
            "dropped_batches": dropped.batches,
            "dropped_samples": dropped.samples,
            "damaged_files": self._spool.damaged,
        }
        for source, report in [("queue", queue), *((name, report()) for name, report in self._reports)]:
            counts_by_path = {path: count for path, count in _counts(report, "") if count}
            if counts_by_path:
                self._streams.record(ACCOUNT_STREAM, now_us, SourceAccount(source, counts_by_path).sample())

    def _losses(self) -> int:
        return self._streams.refused() + self._spool.dropped().samples + self._spool.damaged


def _counts(report: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, int]]:
    """The counts in a source's report, by their dotted path."""
    for name, value in report.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping):
            yield from _counts(value, f"{path}.")
        elif type(value) in (int, float) and name not in _TAKEN:
            yield path, round(value)


@dataclass(frozen=True)
class MetricsConfig:
    """The agent's own figures: one sample of the stream ``agent`` every ``every_s``."""

    enabled: bool = setting(flag(), default=True)
    every_s: float = setting(number(1, 3600, unit="s"), 60.0)


class Rates:
    """Samples a second of each stream, and the time since its last sample."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._at = clock.monotonic()
        self._counts: dict[str, int] = {}
        self._changed: dict[str, float] = {}
        self.per_s: dict[str, float] = {}

    def update(self, counts: Mapping[str, StreamCounts]) -> None:
        """Take the counts; called about once a second."""
        now = self._clock.monotonic()
        passed = now - self._at
        if passed <= 0:
            return
        self._at = now
        for name, count in counts.items():
            new = count.samples - self._counts.get(name, 0)
            self._counts[name] = count.samples
            self.per_s[name] = round(new / passed, 2)
            if new:
                self._changed[name] = now

    def silent_s(self, stream: str) -> float:
        """Seconds since the last sample, to within the time between two updates."""
        return round(self._clock.monotonic() - self._changed.get(stream, self._at), 1)


class AgentMetrics:
    """Makes the samples."""

    def __init__(
        self,
        *,
        clock: Clock,
        spool: Spool,
        uplink: Uplink,
        offset: OffsetEstimator,
        uploads: Uploads | None = None,
    ) -> None:
        self._clock, self._spool, self._uplink, self._offset = clock, spool, uplink, offset
        self._uploads = uploads
        self._at, self._cpu_s, self._samples = clock.monotonic(), time.process_time(), 0
        self._thread_errors = 0

    def sample(self, samples: int) -> dict[str, Value]:
        """The figures since the last call; ``samples`` counts what all sources have given so far."""
        now, cpu_s = self._clock.monotonic(), time.process_time()
        passed = max(now - self._at, 1e-3)
        backlog, dropped, offset = self._spool.backlog(), self._spool.dropped(), self._offset.estimate()
        files = self._uploads.status() if self._uploads is not None else None
        thread_errors = WATCH.errors
        values: dict[str, Value] = {
            "cpu_percent": round((cpu_s - self._cpu_s) / passed * 100, 2),
            "rss_mb": rss_mb(),
            "samples_per_s": round((samples - self._samples) / passed, 2),
            "backlog_batches": backlog.batches,
            "backlog_bytes": backlog.payload_bytes,
            "dropped_batches": dropped.batches,
            "connects": self._uplink.status().connects,
            "clock_offset_ms": offset.offset_ms if offset is not None else None,
            "clock_uncertainty_ms": offset.uncertainty_ms if offset is not None else None,
            "files_waiting": files.waiting if files is not None else 0,
            "files_sent_bytes": files.sent_bytes if files is not None else 0,
            "thread_errors": thread_errors - self._thread_errors,
        }
        self._at, self._cpu_s, self._samples = now, cpu_s, samples
        self._thread_errors = thread_errors
        assert values.keys() == AGENT_FIELDS.keys()
        return values


def rss_mb() -> float:
    """The memory that this process uses; without /proc, the most that it has used."""
    try:
        pages = int(_STATM.read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)
