"""The accounts that an agent's runs publish, compared with the stored batches."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from iort_contract.messages.account import StreamAccount
from iort_station.data.accounts import SILENT_US, Account, accounts, last_of
from iort_station.operations.audit import Audit, RunAudit, Shortfall

__all__ = ["accounts", "held_against", "in_car", "last_of", "without_lateness"]

# What is lost with a run that did not end properly, by whether its queue was durable; None is not known.
_OPEN = "were in open batches, at most one second"
_NOT_ENDED = {
    True: f"{_OPEN}: the run did not end properly",
    False: f"{_OPEN}, or waited in the queue, which was in memory: the run did not end properly",
    None: f"{_OPEN}, or in the queue if it was in memory: the run did not end properly",
}


def held_against(one: Audit, found: Mapping[str, Account], now_us: int) -> Audit:
    """The audit of a stream with its shortfalls against the runs' accounts."""
    stored = {run.boot: run for run in one.runs}
    accounted = {boot: run for boot, run in found.items() if one.stream in run.streams}
    newest_us = max((run.received_us for run in found.values()), default=0)
    shortfalls: list[Shortfall] = []
    for boot, run in accounted.items():
        stream = run.streams[one.stream]
        is_last = run.received_us == newest_us and now_us - run.received_us < SILENT_US
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
