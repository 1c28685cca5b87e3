"""The seconds of a stream: as the summary has them, or computed from the archive once they have expired."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Any

from iort_analysis.archive.stored import PageProgress, Pages, ahead, only
from iort_analysis.samples.batches import Item
from iort_analysis.samples.blocks import Block, column_of, objects
from iort_contract import dynamodb, expression, tables
from iort_contract.archive import Hour
from iort_contract.catalog.derived import SOURCES
from iort_contract.codec import flat_second
from iort_contract.limits import MAX_BATCH_SPAN_US
from iort_contract.statistics import reach, summarize_seconds
from iort_station.cloud import Cloud
from iort_station.data.conditions import holds
from iort_station.data.recorded import Recorded, Selection, summary_table, topic_of
from iort_station.errors import unknown
from iort_station.fleet import registry

_SECOND_US = 1_000_000
# Computed seconds come so many at a time.
_SECONDS = 1000
# The counts of a second.
_COUNTS = (
    tables.SAMPLES,
    tables.BATCHES,
    tables.MISSING_BATCHES,
    tables.GAPS,
    tables.NONFINITE,
    tables.ABSENT,
)


def seconds(
    cloud: Cloud,
    selection: Selection,
    recorded: Recorded,
    *,
    scan: bool = False,
    progress: PageProgress | None = None,
) -> Iterator[Block]:
    """The seconds that start in the selection's range, some at a time; times are their starts.

    Seconds expire with their batches. They are then computed from the archive. A field stands for its
    ``_min``, ``_mean``, ``_max`` and ``_last``. Raises `StationError` for a field that no second has.
    """
    there: dict[str, None] = {}
    for whole in _blocks(cloud, selection, recorded, scan=scan):
        block = whole
        if progress is not None:
            progress(len(block.times_us), int(block.times_us[-1]))
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


def _blocks(cloud: Cloud, selection: Selection, recorded: Recorded, *, scan: bool) -> Iterator[Block]:
    """The seconds as they are stored or computed, in order of time."""
    stored = stored_seconds(cloud, selection, scan=scan) if recorded.reads_table else iter(())
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
    summaries = summarize_seconds(batches, first, end, vehicle)
    while some := list(islice(summaries, _SECONDS)):
        yield _block([{tables.SECOND: second, **_floats(flat_second(summary))} for second, summary in some])


def _floats(second: Mapping[str, Any]) -> dict[str, Any]:
    """As numbers come out of the table: whole ones beyond 2^53 would make a column of objects."""
    return {name: float(value) if type(value) is int else value for name, value in second.items()}


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
    return _block([flat_second({name: _value(value) for name, value in item.items()}) for item in items])


def _block(rows: Sequence[Mapping[str, Any]]) -> Block:
    names = dict.fromkeys(
        name for row in rows for name in row if name not in {tables.TOPIC, tables.SECOND, tables.EXPIRES_S}
    )
    times = objects([row[tables.SECOND] for row in rows]).astype("int64") * 1_000_000
    return Block(times, {name: column_of([row.get(name) for row in rows]) for name in names})


def _value(value: Any) -> Any:
    if "L" in value:
        return [_value(each) for each in value["L"]]
    return float(value["N"]) if "N" in value else dynamodb.deserialize(value)
