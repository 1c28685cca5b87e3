"""The accounts that an agent's runs publish: what each stream and source took, stored and lost."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from iort_analysis.samples.batches import ATTRIBUTES, Item
from iort_contract import dynamodb, tables
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.checks import integer
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount, account, lost
from iort_contract.messages.batch import Batch, BatchId, batch_id, decode_batch
from iort_station.cloud import Cloud
from iort_station.data.recorded import Recorded

# A run that has been silent for this long has ended.
SILENT_US = round(4e6 * ACCOUNT_EVERY_S)


def last_reports(cloud: Cloud, robot: str) -> Iterator[Item]:
    """The stored items with the last report of each run, and others beside them. A report counts from the
    start of its run, so that the earlier ones say nothing more."""
    recorded = Recorded(cloud, robot, ACCOUNT_STREAM)
    last: dict[str, BatchId] = {}
    for item in recorded.headers(dynamodb.starting_between(None, None)):
        with suppress(ContractError):
            report = batch_id(item[tables.BATCH]["S"])
            # Its number decides, since the car's clock may be set back.
            if report.boot not in last or last[report.boot].seq <= report.seq:
                last[report.boot] = report
    for report in last.values():
        # An agent that does not batch sends a report in several messages.
        keys = dynamodb.starting_between(report.t_us - MAX_BATCH_SPAN_US, report.t_us)
        for items in recorded.items(keys, (*ATTRIBUTES, tables.RECEIVED_MS)):
            yield from items


@dataclass
class Account:
    """The last account of a run's streams and sources, and the time at which the cloud received it."""

    streams: dict[str, StreamAccount] = field(default_factory=dict)
    sources: dict[str, SourceAccount] = field(default_factory=dict)
    received_us: int = 0

    def not_recorded(self) -> dict[str, dict[str, int]]:
        """What each source did not record, as counts by cause."""
        causes = {name: lost(source.counts) for name, source in self.sources.items()}
        return {name: counts for name, counts in causes.items() if counts}

    @property
    def ended(self) -> bool:
        """Whether the run ended in good order."""
        return any(stream.ended for stream in self.streams.values())

    @property
    def lost(self) -> int:
        """How many samples the run did not record."""
        refused = sum(stream.refused for stream in self.streams.values())
        return refused + sum(sum(counts.values()) for counts in self.not_recorded().values())


def accounts(cloud: Cloud, robot: str) -> dict[str, Account]:
    """The last account of each run, by the run's name."""
    return last_of(map(dynamodb.plain, last_reports(cloud, robot)))


def last_of(stored: Iterable[Mapping[str, Any]]) -> dict[str, Account]:
    """The last account of each run among stored items. The batch numbers decide which one is last, since the
    car's clock may be set back."""
    batches: list[tuple[Batch, int]] = []
    for item in stored:
        with suppress(ContractError):  # the stream's own audit counts these
            received_ms = integer(item, tables.RECEIVED_MS) if tables.RECEIVED_MS in item else 0
            batches.append((decode_batch(item), received_ms * 1000))
    runs: dict[str, Account] = {}
    for batch, received_us in sorted(batches, key=lambda one: one[0].seq):
        run = runs.setdefault(batch.boot, Account())
        run.received_us = max(run.received_us, received_us)
        for i in range(len(batch.times_us)):
            with suppress(ContractError):
                one = account({name: column[i] for name, column in batch.columns.items()})
                if isinstance(one, StreamAccount):
                    run.streams[one.stream] = one
                else:
                    run.sources[one.source] = one
    return runs
