"""Tells what this run took, stored and did not record, for `iort audit` to hold against the table."""

from __future__ import annotations

from typing import Any, Callable, Iterator, Mapping, Sequence, Tuple

from iort_agent.clock import Clock
from iort_agent.lanes.batch_encoder import StreamCounts
from iort_agent.sources import Emit
from iort_agent.spool.interface import Spool
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount

# Losses are told within a second.
_LOSS_S = 1.0
# Counts of what was given: no cause of anything.
_GIVEN = frozenset({"messages", "samples", "rows", "opened", "silent", "kept", "published"})

Reports = Sequence[Tuple[str, Callable[[], Mapping[str, Any]]]]


class Accounts:
    """Emits the accounts of every stream and source when asked."""

    def __init__(
        self,
        *,
        clock: Clock,
        spool: Spool,
        streams: Sequence[str],
        counts: Callable[[], Mapping[str, StreamCounts]],
        refused: Callable[[], int],
        reports: Reports,
        emit: Emit,
    ) -> None:
        self._clock, self._spool, self._streams = clock, spool, streams
        self._counts, self._refused, self._reports, self._emit = counts, refused, reports, emit
        self._told = clock.monotonic()
        self._lost = 0

    def tick(self) -> None:
        """Tell if it is time; call it several times a second."""
        passed = self._clock.monotonic() - self._told
        if passed >= ACCOUNT_EVERY_S or (passed >= _LOSS_S and self._losses() != self._lost):
            self.tell()

    def tell(self, *, ended: bool = False) -> None:
        """Emit a sample a stream and a source; ``ended`` with the last, once every batch is closed."""
        self._told, self._lost = self._clock.monotonic(), self._losses()
        now_us = self._clock.now_us()
        counted = self._counts()
        for name in sorted({*self._streams, *counted} - {ACCOUNT_STREAM}):
            counts = counted.get(name, StreamCounts())
            of = StreamAccount(
                stream=name,
                taken=counts.samples,
                stored=counts.stored,
                refused=counts.refused,
                nulled=counts.nulled,
                first_seq=0,
                next_seq=counts.batches,
                ended=ended,
            )
            self._emit(ACCOUNT_STREAM, now_us, of.sample())
        dropped = self._spool.dropped()
        queue = {
            "dropped_batches": dropped.batches,
            "dropped_samples": dropped.samples,
            "damaged_files": self._spool.damaged,
        }
        for source, report in [("queue", queue), *((name, report()) for name, report in self._reports)]:
            found = {path: count for path, count in _counts(report, "") if count}
            if found:
                self._emit(ACCOUNT_STREAM, now_us, SourceAccount(source, found).sample())

    def _losses(self) -> int:
        return self._refused() + self._spool.dropped().samples + self._spool.damaged


def _counts(report: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, int]]:
    """The counts in a source's report, by their path in it."""
    for name, value in report.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping):
            yield from _counts(value, f"{path}.")
        elif type(value) in (int, float) and name not in _GIVEN:
            yield path, round(value)
