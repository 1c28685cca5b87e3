"""Stored batches as numpy's columns, some thousand samples at a time.

A `Block` holds the samples of neighbouring batches in order of time. Numbers are float64 with NaN for
null; flags, texts, and integers that a float64 cannot hold exactly keep their own values.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contract import (
    CODEC,
    MAX_BATCH_SPAN_US,
    MAX_FIELDS,
    MAX_SAMPLES,
    SAMPLES,
    SCHEMA_VERSION,
    T_US,
    ContractError,
    Value,
    check_field,
    decode,
    inflate,
)
from station.conditions import Column

# What of a stored item is needed to read its samples.
ATTRIBUTES = ("v", "boot", "seq", T_US, SAMPLES, "nonfinite", "codec", "samples")
# Beyond this a float64 skips integers.
_EXACT = 2.0**53


class Block(NamedTuple):
    """Samples in order of time: int64 microseconds since the epoch, and a column a field."""

    times_us: NDArray[np.int64]
    columns: dict[str, Column]

    def take(self, chosen: Any) -> Block:
        """The samples that a mask, slice or list of indexes chooses."""
        return Block(self.times_us[chosen], {name: column[chosen] for name, column in self.columns.items()})


EMPTY = Block(np.empty(0, dtype=np.int64), {})


class Refused:
    """Counts the stored items that are not batches, and keeps the first one's reason."""

    def __init__(self) -> None:
        self.count = 0
        self.reason = ""

    def add(self, error: Exception) -> None:
        """One more."""
        self.count += 1
        self.reason = self.reason or str(error)


def blocks(
    pages: Iterable[Sequence[Mapping[str, Any]]],
    refused: Refused,
    wanted: Callable[[str], bool] = lambda _name: True,
) -> Iterator[Block]:
    """The samples of pages of items (attribute values as DynamoDB sends them, in order of the batches'
    times), strictly increasing in time and with the fields ``wanted``.

    Batches may reach into one another where a car's clock was set back. Of two samples of the same
    microsecond the one of the batch that starts later counts.
    """
    held = EMPTY
    for items in pages:
        page = _decoded(items, refused, wanted)
        if not len(page.times_us):
            continue
        joined = ordered(join([held, page]))
        # What starts later may still reach before these.
        last_us = int(items[-1][T_US]["N"])
        final = int(np.searchsorted(joined.times_us, last_us, side="right"))
        held = joined.take(slice(final, None))
        if final:
            yield joined.take(slice(final))
    if len(held.times_us):
        yield held


def join(parts: Sequence[Block]) -> Block:
    """The blocks behind one another, with null where one lacks a field that another has."""
    parts = [part for part in parts if len(part.times_us)]
    if len(parts) < 2:
        return parts[0] if parts else EMPTY
    names = dict.fromkeys(name for part in parts for name in part.columns)
    return Block(
        np.concatenate([part.times_us for part in parts]),
        {name: _joined([(part.columns.get(name), len(part.times_us)) for part in parts]) for name in names},
    )


def ordered(block: Block) -> Block:
    """The samples in order of time, one a microsecond: the later of two that share it."""
    times = block.times_us
    if len(times) < 2 or bool((times[1:] > times[:-1]).all()):
        return block
    block = block.take(np.argsort(times, kind="stable"))
    times = block.times_us
    return block.take(np.append(times[1:] > times[:-1], True))


def _joined(parts: Sequence[tuple[Column | None, int]]) -> Column:
    kinds = {column.dtype.kind for column, _ in parts if column is not None}
    if kinds == {"f"} or (kinds == {"b"} and all(column is not None for column, _ in parts)):
        return np.concatenate([np.full(n, np.nan) if column is None else column for column, n in parts])
    mixed = np.empty(sum(n for _, n in parts), dtype=object)
    at = 0
    for column, n in parts:
        if column is not None:
            floats = column.dtype.kind == "f"
            mixed[at : at + n] = [None if floats and math.isnan(v) else v for v in column.tolist()]
        at += n
    return mixed


def _decoded(items: Iterable[Mapping[str, Any]], refused: Refused, wanted: Callable[[str], bool]) -> Block:
    parts: list[Block] = []
    times: list[int] = []
    lists: dict[str, list[Value]] = {}
    fields: list[str] = []
    numeric = True

    def close() -> None:
        if times:
            columns = {name: column_of(column, numeric=numeric) for name, column in lists.items()}
            parts.append(Block(np.array(times, dtype=np.int64), columns))

    for item in items:
        try:
            batch_times, columns, numbers = _open(item)
        except ContractError as error:
            refused.add(error)
            continue
        names = list(columns)
        if names != fields or numbers != numeric:
            close()
            times, fields, numeric = [], names, numbers
            lists = {name: [] for name in names if wanted(name)}
        times += batch_times
        for name, column in lists.items():
            column.extend(columns[name])
    close()
    return join(parts)


_parse = json.JSONDecoder().decode


def _open(item: Mapping[str, Any]) -> tuple[Sequence[int], Mapping[str, Sequence[Value]], bool]:
    """Times and columns of a stored batch, and whether all values are numbers or null.

    A batch of numbers, which nearly all are, is checked as a whole: in JSON without texts, flags and
    nested values there is nothing else that a column could hold. The rest is left to the contract,
    which looks at each value and says what is wrong.
    """
    try:
        n, t_us = int(item[SAMPLES]["N"]), int(item[T_US]["N"])
        if item["v"]["N"] == str(SCHEMA_VERSION) and item["codec"]["S"] == CODEC and 1 <= n <= MAX_SAMPLES:
            body = inflate(item["samples"]["S"])
            found = _numbers(body, n)
            if found is not None and abs(t_us) < _EXACT - MAX_BATCH_SPAN_US:
                dt, columns = found
                return list(accumulate(dt, initial=t_us))[1:], columns, True
    except (KeyError, TypeError, ValueError):
        # Including the contract's errors: its own decoder says it better.
        pass
    batch = decode({name: _plain(value) for name, value in item.items()})
    return batch.times_us, batch.columns, False


def _numbers(body: bytes, n: int) -> tuple[list[int], dict[str, list[Value]]] | None:
    """The columns of a body of numbers alone; None for everything else."""
    if b"true" in body or b"false" in body or b"N" in body or b"I" in body:
        return None
    columns = _parse(body.decode())
    dt, fields = columns["dt"], columns["fields"]
    flat = len(fields) + 1
    if (
        body.count(b'"') != 2 * (flat + 1)
        or body.count(b"[") != flat
        or body.count(b"{") != 2
        or len(fields) > MAX_FIELDS
        or not all(map(_is_field, fields))
        or any(len(column) != n for column in fields.values())
        or len(dt) != n
        or set(map(type, dt)) != {int}
        or dt[0] != 0
        or (n > 1 and min(dt[1:]) <= 0)
        or sum(dt) >= MAX_BATCH_SPAN_US
    ):
        return None
    return dt, fields


@lru_cache(maxsize=4 * MAX_FIELDS)
def _is_field(name: str) -> bool:
    try:
        check_field(name)
    except ContractError:
        return False
    return True


def _plain(value: Mapping[str, Any]) -> Any:
    """An attribute value, numbers as int where they are; the contract refuses what else there is."""
    ((kind, content),) = value.items()
    if kind == "N":
        return int(content) if content.lstrip("-").isdecimal() else float(content)
    return content


def column_of(column: list[Value], *, numeric: bool = False) -> Column:
    """A list of values as a column; ``numeric`` where all are known to be numbers or null."""
    if not numeric:
        kinds = set(map(type, column))
        if kinds == {bool}:
            return np.array(column, dtype=np.bool_)
        if not kinds <= {int, float, type(None)}:
            return objects(column)
    # null becomes NaN.
    array = np.array(column, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        large = np.abs(array) >= _EXACT
    if large.any() and any(
        type(value) is int and int(float(value)) != value
        for value, is_large in zip(column, large.tolist(), strict=True)
        if is_large
    ):
        return objects(column)
    return array


def objects(column: Sequence[Any]) -> Column:
    """A column of Python's own values."""
    array = np.empty(len(column), dtype=object)
    array[:] = column
    return array
