"""Samples put together by time: a mean a bin."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from iort_contract.catalog.vesc import VESC_FIELDS
from iort_station.data.blocks import EMPTY, Block, join
from iort_station.data.conditions import Column

# Of a code or an id no mean is anything; the highest lets no fault within the bin go unseen.
_CODES = frozenset(field.name for field in VESC_FIELDS.values() if field.unit in {"enum", "id"})


def resample(blocks: Iterable[Block], every_us: int) -> Block:
    """One sample a bin of ``every_us``, with the time at which the bin begins, counted from the epoch.

    Numbers become the mean of those that are not null, codes and ids the highest, flags and texts the
    last. A bin without samples is not there. Takes the memory of the result and of one block.
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
            total = np.add.reduceat(np.nan_to_num(column), starts)
            number = np.add.reduceat(np.nan_to_num(counts.columns[name]), starts)
            with np.errstate(invalid="ignore"):
                columns[name] = total / np.where(number == 0, np.nan, number)
    return Block(sums.times_us[starts], columns)


def _binned(block: Block, every_us: int) -> tuple[Block, Block]:
    """Of each bin the sum, highest or last of each column; and how many numbers went into the sum."""
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
            sums[name] = np.add.reduceat(np.where(known, column, 0.0), starts)
            counts[name] = np.add.reduceat(known.astype(float), starts)
    return Block(bins[starts], sums), Block(bins[starts], counts)


def _starts(bins: Column) -> Column:
    return np.flatnonzero(np.append(True, bins[1:] != bins[:-1]))
