"""Blocks of samples: joined, ordered, and averaged over time.

A `Block` holds some thousand samples in order of time, with a numpy array per field. Numbers are float64 with
NaN for null. Flags, texts, and integers that a float64 cannot hold exactly keep their own values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.codec import EXACT
from iort_contract.limits import Value

Column: TypeAlias = NDArray[Any]
# A mean of codes or ids says nothing; the highest hides no fault.
_CODES = frozenset(field.name for field in VESC_FIELDS.values() if field.unit in {"enum", "id"})


class Block(NamedTuple):
    """Samples in order of time: int64 microseconds since the epoch, and a column per field."""

    times_us: NDArray[np.int64]
    columns: dict[str, Column]

    def take(self, chosen: Any) -> Block:
        """The samples that a mask, a slice or indexes select."""
        return Block(self.times_us[chosen], {name: column[chosen] for name, column in self.columns.items()})


EMPTY = Block(np.empty(0, dtype=np.int64), {})


def join(parts: Sequence[Block]) -> Block:
    """All blocks as one, in this order; a field that a block lacks is null there."""
    parts = [part for part in parts if len(part.times_us)]
    if len(parts) < 2:
        return parts[0] if parts else EMPTY
    names = dict.fromkeys(name for part in parts for name in part.columns)
    return Block(
        np.concatenate([part.times_us for part in parts]),
        {name: joined([(part.columns.get(name), len(part.times_us)) for part in parts]) for name in names},
    )


def ordered(block: Block) -> Block:
    """The samples sorted by time; samples of the same time keep their order."""
    times = block.times_us
    if len(times) < 2 or bool((times[1:] >= times[:-1]).all()):
        return block
    return block.take(np.argsort(times, kind="stable"))


def joined(parts: Sequence[tuple[Column | None, int]]) -> Column:
    """Columns as one, given with their lengths; None stands for that many nulls."""
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


def column_of(column: Sequence[Value]) -> Column:
    """A list of values as a column."""
    kinds = set(map(type, column))
    if kinds == {bool}:
        return np.array(column, dtype=np.bool_)
    if not kinds <= {int, float, type(None)}:
        return objects(column)
    # null becomes NaN.
    array = np.array(column, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        large = np.flatnonzero(np.abs(array) >= EXACT)
    # An integer that a float64 rounds makes the whole column one of Python's values.
    if any(type(value := column[i]) is int and int(float(value)) != value for i in large.tolist()):
        return objects(column)
    return array


def exact(column: Sequence[Value]) -> Column:
    """The same, with integers of more than 53 bits as Python's: a float64 does not tell them from floats."""
    large = any(type(value) is int and abs(value) >= EXACT for value in column)
    return objects(column) if large else column_of(column)


def objects(column: Sequence[Any]) -> Column:
    """A column of Python objects."""
    array = np.empty(len(column), dtype=object)
    array[:] = column
    return array


def values(column: Column) -> list[Value]:
    """A column as Python values; None for null and for numbers that are not finite."""
    plain: list[Value] = column.tolist()
    if column.dtype.kind == "f" and not (finite := np.isfinite(column)).all():
        return [value if is_finite else None for value, is_finite in zip(plain, finite, strict=True)]
    return plain


def resample(blocks: Iterable[Block], every_us: int) -> Block:
    """One sample per bin of ``every_us``, at the bin's start; bins are counted from the epoch.

    Numbers become their mean without nulls, codes and ids their maximum, flags and texts the last one. Bins
    without samples are left out. It takes the memory of the result and of one block.
    """
    parts = [_binned(block, every_us) for block in blocks]
    sums, counts = join([part[0] for part in parts]), join([part[1] for part in parts])
    if not len(sums.times_us):
        return EMPTY
    starts = _starts(sums.times_us)
    columns: dict[str, Column] = {}
    for name, column in sums.columns.items():
        if column.dtype.kind != "f":
            columns[name] = column[np.append(starts[1:], len(column)) - 1]
        elif name in _CODES:
            columns[name] = np.fmax.reduceat(column, starts)
        else:
            number = np.add.reduceat(np.nan_to_num(counts.columns[name]), starts)
            # A sum that no number holds is infinite, and so is its mean.
            with np.errstate(invalid="ignore", over="ignore"):
                total = np.add.reduceat(np.where(np.isnan(column), 0.0, column), starts)
                columns[name] = total / np.where(number == 0, np.nan, number)
    return Block(sums.times_us[starts], columns)


def _binned(block: Block, every_us: int) -> tuple[Block, Block]:
    """The sum, maximum or last value of each bin and column; and the number of values in each sum."""
    if not len(block.times_us):
        return EMPTY, EMPTY
    bins = block.times_us // every_us * every_us
    starts = _starts(bins)
    ends = np.append(starts[1:], len(bins)) - 1
    sums: dict[str, Column] = {}
    counts: dict[str, Column] = {}
    for name, column in block.columns.items():
        if column.dtype.kind != "f":
            sums[name] = column[ends]
        elif name in _CODES:
            sums[name] = np.fmax.reduceat(column, starts)
        else:
            known = ~np.isnan(column)
            with np.errstate(over="ignore"):
                sums[name] = np.add.reduceat(np.where(known, column, 0.0), starts)
            counts[name] = np.add.reduceat(known.astype(float), starts)
    return Block(bins[starts], sums), Block(bins[starts], counts)


def _starts(bins: Column) -> Column:
    return np.flatnonzero(np.append(True, bins[1:] != bins[:-1]))
