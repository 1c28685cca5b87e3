"""What the runs of an agent say of their record, held against what is stored."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount, account, lost
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.tables import RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.operations.audit import Audit, Run, Shortfall
from iort_station.operations.delivery import items

# A run that has said nothing for so long has ended.
_SILENT_US = round(4e6 * ACCOUNT_EVERY_S)


@dataclass
class Account:
    """The last that a run said: of its streams, of its sources, and when the cloud heard it."""

    streams: dict[str, StreamAccount] = field(default_factory=dict)
    sources: dict[str, SourceAccount] = field(default_factory=dict)
    told_us: int = 0

    def not_recorded(self) -> dict[str, dict[str, int]]:
        """Of each source that has any, the counts that stand for something which is not in the record."""
        found = {name: lost(said.counts) for name, said in self.sources.items()}
        return {name: counts for name, counts in found.items() if counts}


def accounts(cloud: Cloud, robot: str) -> dict[str, Account]:
    """The last account of each run, by the run's name."""
    return last_of(items(cloud, robot, ACCOUNT_STREAM))


def last_of(stored: Iterable[Mapping[str, Any]]) -> dict[str, Account]:
    """The last account of each run among the items of its stream: the last by the batches' numbers, since the
    car's clock may have been set back while it drove."""
    batches: list[tuple[Batch, int]] = []
    for item in stored:
        with suppress(ContractError):  # the audit of the stream itself counts those
            batches.append((decode_batch(item), int(item.get(RECEIVED_MS, 0)) * 1000))
    found: dict[str, Account] = {}
    for batch, received_us in sorted(batches, key=lambda one: one[0].seq):
        run = found.setdefault(batch.boot, Account())
        run.told_us = max(run.told_us, received_us)
        for i in range(len(batch.times_us)):
            sample = {name: column[i] for name, column in batch.columns.items()}
            with suppress(ContractError):
                said = account(sample)
                if isinstance(said, StreamAccount):
                    run.streams[said.stream] = said
                else:
                    run.sources[said.source] = said
    return found


def held_against(one: Audit, found: Mapping[str, Account], now_us: int) -> Audit:
    """The audit of a stream, with in what it falls short of the runs' accounts of it."""
    stored = {run.boot: run for run in one.runs}
    told = {boot: run for boot, run in found.items() if one.stream in run.streams}
    newest = max((run.told_us for run in found.values()), default=0)
    shortfalls: list[Shortfall] = []
    for boot, run in told.items():
        said = run.streams[one.stream]
        running = not said.ended and run.told_us == newest and now_us - run.told_us < _SILENT_US
        shortfalls += _shortfalls(boot, said, stored.get(boot), running=running)
    taken = sum(run.streams[one.stream].taken for run in told.values()) if told else None
    return replace(one, taken=taken, shortfalls=tuple(shortfalls))


def _shortfalls(boot: str, said: StreamAccount, stored: Run | None, *, running: bool) -> Iterable[Shortfall]:
    if said.refused:
        yield Shortfall(boot, said.refused, "refused by the agent: no message can hold them")
    if not said.ended and not running:
        yield Shortfall(
            boot, None, "were in open batches, at most those of a second: the run did not end in good order"
        )
    if stored is None:
        if said.stored:
            yield Shortfall(boot, said.stored, "in batches of which none is stored")
        return
    # What lies before the first stored number is told apart: it may have expired. What a run that goes on has
    # not delivered yet is on its way.
    if stored.first_seq > said.first_seq or (running and stored.last_seq < said.next_seq - 1):
        return
    there = sum(samples for seq, samples in stored.samples_of.items() if seq < said.next_seq)
    if there != said.stored:
        yield Shortfall(boot, said.stored - there, "put into the queue, and not in the table")
