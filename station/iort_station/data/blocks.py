"""Samples as numpy's columns, some thousand at a time.

A `Block` holds samples in order of time. Numbers are float64 with NaN for null; flags, texts, and integers
that a float64 cannot hold exactly keep their own values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_contract.codec.columns import EXACT
from iort_contract.limits import Value
from iort_station.data.conditions import Column


class Block(NamedTuple):
    """Samples in order of time: int64 microseconds since the epoch, and a column a field."""

    times_us: NDArray[np.int64]
    columns: dict[str, Column]

    def take(self, chosen: Any) -> Block:
        """The samples that a mask, slice or list of indexes chooses."""
        return Block(self.times_us[chosen], {name: column[chosen] for name, column in self.columns.items()})


EMPTY = Block(np.empty(0, dtype=np.int64), {})


def join(parts: Sequence[Block]) -> Block:
    """The blocks behind one another, with null where one lacks a field that another has."""
    parts = [part for part in parts if len(part.times_us)]
    if len(parts) < 2:
        return parts[0] if parts else EMPTY
    names = dict.fromkeys(name for part in parts for name in part.columns)
    return Block(
        np.concatenate([part.times_us for part in parts]),
        {name: joined([(part.columns.get(name), len(part.times_us)) for part in parts]) for name in names},
    )


def ordered(block: Block) -> Block:
    """The samples in order of time; those of the same time stay as they are."""
    times = block.times_us
    if len(times) < 2 or bool((times[1:] >= times[:-1]).all()):
        return block
    return block.take(np.argsort(times, kind="stable"))


def joined(parts: Sequence[tuple[Column | None, int]]) -> Column:
    """Columns behind one another, with the length of each; None is so many nulls."""
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
        large = np.abs(array) >= EXACT
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
