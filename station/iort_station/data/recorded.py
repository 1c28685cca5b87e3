"""What is stored of a stream: its batches, in table and archive, the agent's last reports, and its seconds.

`iort_analysis.archive.stored` merges table and archive; this module gives it a deployment's. Seconds are
read as the summary has them, or computed from the archive once they have expired.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from iort_analysis.archive.hours import Archive, Stores
from iort_analysis.archive.stored import AUTO, Origin, PageProgress, Pages, Source, Stored, ahead, only
from iort_analysis.samples.batches import ATTRIBUTES, Item, RefusedItems
from iort_analysis.samples.blocks import Block, column_of, objects
from iort_analysis.samples.seconds import reach, summarized
from iort_contract import dynamodb, expression, tables
from iort_contract.archive import ArchiveTable, Hour
from iort_contract.catalog.derived import SOURCES
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.checks import integer
from iort_contract.codec import flat_second
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S, SourceAccount, StreamAccount, account, lost
from iort_contract.messages.batch import Batch, BatchId, batch_id, decode_batch
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data.selection import Selection, derive, holds
from iort_station.errors import unknown
from iort_station.fleet import registry

# A run that has been silent for this long has ended.
SILENT_US = round(4e6 * ACCOUNT_EVERY_S)


def telemetry_table(cloud: Cloud) -> dynamodb.TelemetryTable:
    """The deployment's telemetry table."""
    return dynamodb.TelemetryTable(cloud.client("dynamodb"), cloud.output("storage", "TelemetryTable"))


def summary_table(cloud: Cloud) -> dynamodb.SummaryTable:
    """The deployment's summary table."""
    return dynamodb.SummaryTable(cloud.client("dynamodb"), cloud.output("storage", "SummaryTable"))


def topic_of(cloud: Cloud, robot: str, stream: str) -> str:
    """The topic of a robot's stream on the record lane."""
    return build_topic(RECORD, robot, stream, cloud.namespace)


class Recorded(Stored):
    """The batches of a robot's stream. ``origin`` and ``refused`` grow while they are read."""

    def __init__(
        self,
        cloud: Cloud,
        robot: str,
        stream: str,
        *,
        source: Source = AUTO,
        origin: Origin | None = None,
        refused: RefusedItems | None = None,
    ) -> None:
        topic = topic_of(cloud, robot, stream)
        super().__init__(stores(cloud), topic, source=source, origin=origin, refused=refused)


def archive_of(cloud: Cloud, topic: str) -> Archive:
    """The archive of a topic."""
    return Archive(stores(cloud), topic)


def stores(cloud: Cloud) -> Stores:
    """Where a deployment's recordings are."""
    manifest = ArchiveTable(cloud.client("dynamodb"), cloud.output("storage", "ArchiveTable"))
    return Stores(
        telemetry_table(cloud), manifest, lambda: (cloud.client("s3"), cloud.output("storage", "FilesBucket"))
    )


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


_SECOND_US = 1_000_000
# The counts of a second.
_COUNTS = (
    tables.SAMPLES,
    tables.BATCHES,
    tables.MISSING_BATCHES,
    tables.GAPS,
    tables.NONFINITE,
    tables.ABSENT,
)


@dataclass
class Reading:
    """How a query reads, and what it learns. ``progress`` is called for each page, ``scan`` reads by Scan.

    ``refused`` counts what cannot be read, ``origin`` what comes from the archive, and ``absent`` the values
    by field that became null because their sensor is not fitted; with None they stay as recorded.
    """

    source: Source = AUTO
    scan: bool = False
    progress: PageProgress | None = None
    refused: RefusedItems = field(default_factory=RefusedItems)
    origin: Origin = field(default_factory=Origin)
    absent: Counter[str] | None = None

    def recorded(self, cloud: Cloud, selection: Selection) -> Recorded:
        """The stream's batches, for this reading."""
        return Recorded(
            cloud,
            selection.robot,
            selection.stream,
            source=self.source,
            origin=self.origin,
            refused=self.refused,
        )


def seconds(cloud: Cloud, selection: Selection, reading: Reading) -> Iterator[Block]:
    """The seconds that start in the selection's range, some at a time; times are their starts.

    Seconds expire with their batches. They are then computed from the archive. A field stands for its
    ``_min``, ``_mean``, ``_max`` and ``_last``. Raises `StationError` for a field that no second has.
    """
    there: dict[str, None] = {}
    for whole in _blocks(cloud, selection, reading):
        block = whole
        if reading.progress is not None:
            reading.progress(len(block.times_us), int(block.times_us[-1]))
        there |= dict.fromkeys(block.columns)
        if selection.condition is not None:
            block = block.take(holds(selection.condition, block.columns, len(block.times_us)))
        if selection.fields is not None:
            chosen = [full for name in selection.fields for full in _stands_for(name, block.columns)]
            block = Block(block.times_us, {name: block.columns[name] for name in chosen})
        if len(block.times_us):
            yield block
    # A condition must name a single statistic.
    compared = expression.names(selection.condition) if selection.condition is not None else set()
    missing = sorted(
        {name for name in selection.named() if not _stands_for(name, there)} | (compared - there.keys())
    )
    if there and missing:
        problem = f"the summary of {selection.robot} {selection.stream} has no {', '.join(missing)}"
        raise unknown(problem, missing, there, f"iort streams {selection.robot}")


def _blocks(cloud: Cloud, selection: Selection, reading: Reading) -> Iterator[Block]:
    """The seconds as they are stored or computed, in order of time."""
    recorded = reading.recorded(cloud, selection)
    stored = stored_seconds(cloud, selection, scan=reading.scan) if recorded.reads_table else iter(())
    table = Pages(stored, _second)
    first, last = _range_s(selection)
    keys = dynamodb.with_samples_between(selection.start_us, selection.end_us)
    for start_s, end_s in _spans(recorded.archived(keys)):
        start, end = max(start_s, first or start_s), min(end_s, end_s if last is None else last + 1)
        yield from map(_block_of_seconds, table.until(start))
        # Some of these may still be there.
        deque(table.until(end), maxlen=0)
        yield from _computed(cloud, selection, recorded, start, end)
    yield from map(_block_of_seconds, table.until(None))


def _spans(hours: Iterable[Hour]) -> list[tuple[int, int]]:
    """The seconds with samples of these hours' batches; the last of an hour may go on in the next hour."""
    spans: list[tuple[int, int]] = []
    for hour in hours:
        start, end = hour.start_us // _SECOND_US, (hour.end_us + MAX_BATCH_SPAN_US) // _SECOND_US
        if spans and start < spans[-1][1]:
            start = spans.pop()[0]
        spans.append((start, end))
    return spans


def _computed(
    cloud: Cloud, selection: Selection, recorded: Recorded, first: int, end: int
) -> Iterator[Block]:
    """The seconds from ``first`` until ``end``, made from their batches."""
    vehicle = registry.vehicle_of(cloud, selection.robot)
    keys = dynamodb.starting_between(*reach(first, end))
    wanted = _needs(selection)
    before = recorded.before(reach(first, end)[0])
    earlier = () if before is None else recorded.batches(only(before), wanted)
    batches = chain(earlier, recorded.batches(keys, wanted))
    yield from summarized(batches, first, end, lambda columns: derive(columns, vehicle))


def _needs(selection: Selection) -> Callable[[str], bool]:
    """Which fields decide about the answer."""
    named = selection.named()
    if selection.fields is None or tables.ABSENT in named:
        return lambda _name: True
    fields = named | {name.rpartition("_")[0] for name in named}
    fields |= {source for name in fields & SOURCES.keys() for source in SOURCES[name]}
    return fields.__contains__


def stored_seconds(cloud: Cloud, selection: Selection, *, scan: bool = False) -> Iterator[Sequence[Item]]:
    """Pages of the summary's seconds that start in the selection's range, in order of time."""
    topic = topic_of(cloud, selection.robot, selection.stream)
    pages = summary_table(cloud).pages(topic, dynamodb.seconds_between(*_range_s(selection)), scan=scan)
    if not scan:
        yield from ahead(page.items for page in pages)
    else:
        # A scan has no order.
        yield sorted((item for page in pages for item in page.items), key=_second)


def _range_s(selection: Selection) -> tuple[int | None, int | None]:
    """The first and the last second of a range."""
    first = None if selection.start_us is None else -(-selection.start_us // _SECOND_US)
    return first, None if selection.end_us is None else (selection.end_us - 1) // _SECOND_US


def _second(item: Item) -> int:
    return int(item[tables.SECOND]["N"])


def in_column_order(block: Block) -> Block:
    """The block with its counts first; the columns then do not depend on how many seconds are read at a
    time."""
    whole = [name for name in _COUNTS if name in block.columns]
    rest = sorted(name for name in block.columns if name not in whole)
    return Block(block.times_us, {name: block.columns[name] for name in (*whole, *rest)})


def _stands_for(name: str, there: Mapping[str, Any]) -> list[str]:
    if name in there:
        return [name]
    return [full for statistic in tables.STATS if (full := f"{name}_{statistic}") in there]


def _block_of_seconds(items: Sequence[Item]) -> Block:
    rows = [flat_second({name: _value(value) for name, value in item.items()}) for item in items]
    names = dict.fromkeys(
        name for row in rows for name in row if name not in {tables.TOPIC, tables.SECOND, tables.EXPIRES_S}
    )
    times = objects([row[tables.SECOND] for row in rows]).astype("int64") * 1_000_000
    return Block(times, {name: column_of([row.get(name) for row in rows]) for name in names})


def _value(value: Any) -> Any:
    if "L" in value:
        return [_value(each) for each in value["L"]]
    return float(value["N"]) if "N" in value else dynamodb.deserialize(value)
