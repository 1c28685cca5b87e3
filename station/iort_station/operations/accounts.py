"""The accounts that an agent's runs publish, compared with the stored batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from iort_contract.checks import integer
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount, account, lost
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.tables import RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.data.recorded import last_reports
from iort_station.operations.audit import Audit, RunAudit, Shortfall

# A run that has been silent for this long has ended.
_SILENT_US = round(4e6 * ACCOUNT_EVERY_S)
# What is lost with a run that did not end properly, by whether its queue was durable; None is not known.
_OPEN = "were in open batches, at most one second"
_NOT_ENDED = {
    True: f"{_OPEN}: the run did not end properly",
    False: f"{_OPEN}, or waited in the queue, which was in memory: the run did not end properly",
    None: f"{_OPEN}, or in the queue if it was in memory: the run did not end properly",
}


@dataclass
class Account:
    """The last account of a run's streams and sources, and the time at which the cloud received it."""

    streams: dict[str, StreamAccount] = field(default_factory=dict)
    sources: dict[str, SourceAccount] = field(default_factory=dict)
    received_us: int = 0

    def not_recorded(self) -> dict[str, dict[str, int]]:
        """What each source did not record, as counts by cause."""
        found = {name: lost(source.counts) for name, source in self.sources.items()}
        return {name: counts for name, counts in found.items() if counts}


def accounts(cloud: Cloud, robot: str) -> dict[str, Account]:
    """The last account of each run, by the run's name."""
    return last_of(map(plain, last_reports(cloud, robot)))


def last_of(stored: Iterable[Mapping[str, Any]]) -> dict[str, Account]:
    """The last account of each run among stored items. The batch numbers decide which one is last, since the
    car's clock may be set back."""
    batches: list[tuple[Batch, int]] = []
    for item in stored:
        with suppress(ContractError):  # the stream's own audit counts these
            received_ms = integer(item, RECEIVED_MS) if RECEIVED_MS in item else 0
            batches.append((decode_batch(item), received_ms * 1000))
    found: dict[str, Account] = {}
    for batch, received_us in sorted(batches, key=lambda one: one[0].seq):
        run = found.setdefault(batch.boot, Account())
        run.received_us = max(run.received_us, received_us)
        for i in range(len(batch.times_us)):
            with suppress(ContractError):
                one = account({name: column[i] for name, column in batch.columns.items()})
                if isinstance(one, StreamAccount):
                    run.streams[one.stream] = one
                else:
                    run.sources[one.source] = one
    return found


def held_against(one: Audit, found: Mapping[str, Account], now_us: int) -> Audit:
    """The audit of a stream with its shortfalls against the runs' accounts."""
    stored = {run.boot: run for run in one.runs}
    accounted = {boot: run for boot, run in found.items() if one.stream in run.streams}
    newest_us = max((run.received_us for run in found.values()), default=0)
    shortfalls: list[Shortfall] = []
    for boot, run in accounted.items():
        stream = run.streams[one.stream]
        is_last = run.received_us == newest_us and now_us - run.received_us < _SILENT_US
        running = is_last and not stream.ended
        shortfalls += _shortfalls(boot, stream, stored.get(boot), running=running)
    taken = sum(run.streams[one.stream].taken for run in accounted.values()) if accounted else None
    return replace(one, taken=taken, shortfalls=tuple(shortfalls))


def without_lateness(one: Audit, found: Mapping[str, Account]) -> Audit:
    """The audit without the lateness of recordings that were played at another speed than their own."""

    def told(run: RunAudit) -> RunAudit:
        account = found[run.boot].streams.get(one.stream) if run.boot in found else None
        return replace(run, late=None, latest_ms=None) if account is not None and account.replayed else run

    return replace(one, runs=[told(run) for run in one.runs])


def in_car(last: int | None, audits: Iterable[Audit], found: Mapping[str, Account]) -> int | None:
    """How many batches are in the car: the figure that it sent last, which is of a minute before its end. A
    run that ended in good order says so in its last batch, behind all others: it has left nothing."""
    newest = max(found.values(), key=lambda run: run.received_us, default=None)
    ended = newest is not None and all(stream.ended for stream in newest.streams.values())
    return 0 if last and ended and not any(one.missing or one.shortfalls for one in audits) else last


def _shortfalls(
    boot: str, stream: StreamAccount, stored: RunAudit | None, *, running: bool
) -> Iterator[Shortfall]:
    if stream.refused:
        yield Shortfall(boot, stream.refused, "refused by the agent: no message can hold them")
    if not stream.ended and not running:
        yield Shortfall(boot, None, _NOT_ENDED[stream.durable])
    if stored is None:
        if stream.stored:
            yield Shortfall(boot, stream.stored, "in batches that are not stored")
        return
    # `Audit.before_first` reports numbers before the first stored one, which may have expired. The last
    # batches of a running agent may be on their way.
    if stored.first_seq > stream.first_seq or (running and stored.last_seq < stream.next_seq - 1):
        return
    there = sum(samples for seq, samples in stored.samples_of.items() if seq < stream.next_seq)
    if there != stream.stored:
        yield Shortfall(boot, stream.stored - there, "put into the queue, but not in the table")
