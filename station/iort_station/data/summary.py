"""The summary that Lambda 2 has written, with one sample per second."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from iort_analysis.samples.batches import Item
from iort_analysis.samples.blocks import Block, column_of, objects
from iort_contract import expression
from iort_contract.codec.seconds import flat_second
from iort_contract.dynamodb import deserialize, seconds_between
from iort_contract.tables import (
    ABSENT,
    BATCHES,
    EXPIRES_S,
    GAPS,
    MISSING_BATCHES,
    NONFINITE,
    SAMPLES,
    SECOND,
    STATS,
    TOPIC,
)
from iort_station.cloud import Cloud
from iort_station.data.batches import PageProgress, ahead, summary_table, topic_of
from iort_station.data.conditions import holds
from iort_station.data.selection import Selection
from iort_station.errors import unknown

# The counts of a second.
_COUNTS = (SAMPLES, BATCHES, MISSING_BATCHES, GAPS, NONFINITE, ABSENT)


def seconds(
    cloud: Cloud, selection: Selection, *, scan: bool = False, progress: PageProgress | None = None
) -> Iterator[Block]:
    """The seconds that start in the selection's range, one block per page; times are their starts.

    A field stands for its ``_min``, ``_mean``, ``_max`` and ``_last``. Raises `StationError` for a field that
    no second has.
    """
    there: dict[str, None] = {}
    for items in stored(cloud, selection, scan=scan):
        if not items:
            continue
        block = _block(items)
        if progress is not None:
            progress(len(items), int(block.times_us[-1]))
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


def stored(cloud: Cloud, selection: Selection, *, scan: bool = False) -> Iterator[Sequence[Item]]:
    """Pages of the summary's seconds that start in the selection's range, in order of time."""
    first_s = None if selection.start_us is None else -(-selection.start_us // 1_000_000)
    last_s = None if selection.end_us is None else (selection.end_us - 1) // 1_000_000
    topic = topic_of(cloud, selection.robot, selection.stream)
    pages = summary_table(cloud).pages(topic, seconds_between(first_s, last_s), scan=scan)
    if not scan:
        yield from ahead(page.items for page in pages)
    else:
        # A scan has no order.
        yield sorted((item for page in pages for item in page.items), key=lambda item: int(item[SECOND]["N"]))


def _stands_for(name: str, there: Mapping[str, Any]) -> list[str]:
    if name in there:
        return [name]
    return [full for statistic in STATS if (full := f"{name}_{statistic}") in there]


def _block(items: Sequence[Item]) -> Block:
    rows = [flat_second({name: _value(value) for name, value in item.items()}) for item in items]
    names = dict.fromkeys(name for row in rows for name in row if name not in {TOPIC, SECOND, EXPIRES_S})
    whole = [name for name in _COUNTS if name in names]
    ordered = [*whole, *sorted(name for name in names if name not in whole)]
    times = objects([row[SECOND] for row in rows]).astype("int64") * 1_000_000
    return Block(times, {name: column_of([row.get(name) for row in rows]) for name in ordered})


def _value(value: Any) -> Any:
    if "L" in value:
        return [_value(each) for each in value["L"]]
    return float(value["N"]) if "N" in value else deserialize(value)
