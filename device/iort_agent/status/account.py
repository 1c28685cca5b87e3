"""Reports what this run took, stored and did not record; `iort audit` compares it with the table."""

from __future__ import annotations

from typing import Any, Callable, Iterator, Mapping, Sequence, Tuple

from iort_agent.clock import Clock
from iort_agent.lanes.streams import StreamCounts, Streams
from iort_agent.spool import Spool
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount

# A loss is reported within a second.
_LOSS_S = 1.0
# Counts of what was taken, not of losses.
_TAKEN = frozenset({"messages", "samples", "rows", "opened", "silent", "kept", "published"})

# A source's name, and a function that returns its counts.
Reports = Sequence[Tuple[str, Callable[[], Mapping[str, Any]]]]


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
            found = {path: count for path, count in _counts(report, "") if count}
            if found:
                self._streams.record(ACCOUNT_STREAM, now_us, SourceAccount(source, found).sample())

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
