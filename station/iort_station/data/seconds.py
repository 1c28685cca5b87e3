"""The summary that Lambda 2 has written, a second a sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from boto3.dynamodb.types import TypeDeserializer

from iort_contract import expression
from iort_contract.codec.seconds import flat_second
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
from iort_station.data import reading
from iort_station.data.blocks import Block, objects
from iort_station.data.conditions import Column, holds
from iort_station.data.reading import Item, Told
from iort_station.data.selection import Selection
from iort_station.errors import StationError

# What a second says of its samples as a whole.
_OF_ALL = (SAMPLES, BATCHES, MISSING_BATCHES, GAPS, NONFINITE, ABSENT)
_deserialize = TypeDeserializer().deserialize


def seconds(
    cloud: Cloud, selection: Selection, *, scan: bool = False, progress: Told | None = None
) -> Iterator[Block]:
    """The selection's seconds, a block a page; times are those at which they begin.

    A field stands for its ``_min``, ``_mean``, ``_max`` and ``_last``, as far as it has them. Raises
    `StationError` for a field that no second has.
    """
    there: dict[str, None] = {}
    for items in reading.told(reading.seconds(cloud, selection, scan=scan), progress):
        if not items:
            continue
        block = _block(items)
        there |= dict.fromkeys(block.columns)
        if selection.condition is not None:
            block = block.take(holds(selection.condition, block.columns, len(block.times_us)))
        if selection.fields is not None:
            chosen = [full for name in selection.fields for full in _stands_for(name, block.columns)]
            block = Block(block.times_us, {name: block.columns[name] for name in chosen})
        if len(block.times_us):
            yield block
    # A condition compares one number a second, so it says which.
    compared = expression.names(selection.condition) if selection.condition is not None else set()
    unknown = sorted(
        {name for name in selection.named() if not _stands_for(name, there)} | (compared - there.keys())
    )
    if there and unknown:
        raise StationError(
            f"the summary of {selection.robot} {selection.stream} has no {', '.join(unknown)}; "
            f"it has {', '.join(there)}"
        )


def _stands_for(name: str, there: Mapping[str, Any]) -> list[str]:
    if name in there:
        return [name]
    return [full for statistic in STATS if (full := f"{name}_{statistic}") in there]


def _block(items: Sequence[Item]) -> Block:
    rows = [flat_second({name: _value(value) for name, value in item.items()}) for item in items]
    names = dict.fromkeys(name for row in rows for name in row if name not in {TOPIC, SECOND, EXPIRES_S})
    whole = [name for name in _OF_ALL if name in names]
    ordered = [*whole, *sorted(name for name in names if name not in whole)]
    times = objects([row[SECOND] for row in rows]).astype("int64") * 1_000_000
    return Block(times, {name: _column([row.get(name) for row in rows]) for name in ordered})


def _value(value: Any) -> Any:
    if "L" in value:
        return [_value(each) for each in value["L"]]
    return float(value["N"]) if "N" in value else _deserialize(value)


def _column(values: Sequence[Any]) -> Column:
    numbers = all(value is None or isinstance(value, float) for value in values)
    return objects(values).astype(float) if numbers else objects(values)
