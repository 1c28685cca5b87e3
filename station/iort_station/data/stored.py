"""Stored batches as blocks of samples: numbers by numpy, a page at a time, the rest by the contract."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import accumulate, chain, groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_contract.checks import check_field
from iort_contract.codec.columns import CODEC, EXACT, PLAIN_CODEC, SCALES, SERIALIZED_CODEC, inflate
from iort_contract.codec.complexity_guard import check_effort
from iort_contract.limits import (
    BATCH_VERSION,
    MAX_BATCH_SPAN_US,
    MAX_BATCH_VALUES,
    MAX_FIELDS,
    MAX_SAMPLES,
    ContractError,
    Value,
)
from iort_contract.messages.batch import Batch, batch_id, decode_batch
from iort_contract.tables import BATCH, NONFINITE, SAMPLES
from iort_station.data.blocks import EMPTY, Block, column_of, join, joined, ordered
from iort_station.data.conditions import Column
from iort_station.data.reading import time_of

# What of a stored item is needed to read its samples.
ATTRIBUTES = ("v", BATCH, SAMPLES, NONFINITE, "codec", "samples")
_SCALES = np.array(SCALES)
_OF_64_BITS = 2.0**63
Item = Mapping[str, Any]
Wanted = Callable[[str], bool]


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
    pages: Iterable[Sequence[Item]],
    refused: Refused,
    wanted: Wanted = lambda _name: True,
    *,
    messages: bool = True,
) -> Iterator[Block]:
    """The samples of pages of items (attribute values as DynamoDB sends them, in order of the batches'
    times), in order of time and with the fields ``wanted``.

    Batches may reach into one another where a car's clock was set back, or several publish on a topic.
    Without ``messages`` batches of ROS messages are passed over.
    """
    held = EMPTY
    for items in pages:
        chosen = items if messages else [item for item in items if not _is_messages(item)]
        page = _read(chosen, refused, wanted)
        if not len(page.times_us):
            continue
        both = ordered(join([held, page]))
        # What starts later may still reach before these.
        last_us = time_of(items[-1])
        final = int(np.searchsorted(both.times_us, last_us, side="left"))
        held = both.take(slice(final, None))
        if final:
            yield both.take(slice(final))
    if len(held.times_us):
        yield held


def _is_messages(item: Item) -> bool:
    try:
        codec = item["codec"]["S"]
        return codec == SERIALIZED_CODEC or b"\n" in inflate(item["samples"]["S"], codec)
    except (ContractError, KeyError):
        return False


class _Open(NamedTuple):
    """An item whose samples look like numbers alone: ``columns`` as they are written, decimals first.

    ``names`` is None where the contract has to look at every value.
    """

    item: Item
    names: tuple[str, ...] | None
    times_us: Sequence[int]
    columns: Mapping[str, list[Any]]


def _read(items: Iterable[Item], refused: Refused, wanted: Wanted) -> Block:
    parts: list[Block] = []
    for names, opened in groupby(map(_open, items), key=lambda one: one.names):
        run = list(opened)
        block = None if names is None else _numbers(run, list(filter(wanted, names)))
        parts += _by_contract((one.item for one in run), refused, wanted) if block is None else [block]
    return join(parts)


def _by_contract(items: Iterable[Item], refused: Refused, wanted: Wanted) -> Iterator[Block]:
    """The same, value by value: for what is more than numbers, and for what is wrong."""
    batches = (batch for item in items for batch in _decoded(item, refused))
    for names, same in groupby(batches, key=lambda batch: list(batch.columns)):
        run = list(same)
        columns = {
            name: column_of(list(chain.from_iterable(batch.columns[name] for batch in run)))
            for name in names
            if wanted(name)
        }
        times = np.fromiter(chain.from_iterable(batch.times_us for batch in run), dtype=np.int64)
        yield Block(times, columns)


def _decoded(item: Item, refused: Refused) -> list[Batch]:
    """The batch, if it is one."""
    try:
        return [decode_batch({name: _plain(value) for name, value in item.items()})]
    except ContractError as error:
        refused.add(error)
        return []


_parse = json.JSONDecoder().decode


def _open(item: Item) -> _Open:
    """A stored batch, as far as it can be checked as a whole.

    In JSON without texts, flags and nested values there is nothing but numbers and null that a column
    could hold. The rest is left to the contract, which looks at each value and says what is wrong.
    """
    try:
        n, codec = int(item[SAMPLES]["N"]), item["codec"]["S"]
        known = item["v"]["N"] == str(BATCH_VERSION) and codec in {CODEC, PLAIN_CODEC}
        if known and _is_count(item.get(NONFINITE)) and 1 <= n <= MAX_SAMPLES:
            t_us = batch_id(item[BATCH]["S"]).t_us
            # What stands behind the columns is for those who make messages of them.
            body = inflate(item["samples"]["S"], codec).partition(b"\n")[0]
            found = _columns(body, n, codec)
            if found is not None and t_us < EXACT - MAX_BATCH_SPAN_US:
                dt, columns = found
                return _Open(item, tuple(columns), list(accumulate(dt, initial=t_us))[1:], columns)
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError):
        # Including the contract's errors: its own decoder says it better.
        pass
    return _Open(item, None, (), {})


def _is_count(value: Mapping[str, str] | None) -> bool:
    """Whether it is none, or one that the contract need not look at."""
    return value is None or (value["N"].isdecimal() and len(value["N"]) < 6)


def _columns(body: bytes, n: int, codec: str) -> tuple[list[int], dict[str, list[Any]]] | None:
    """The columns of a body of numbers alone; None for everything else."""
    if b"true" in body or b"false" in body or b"N" in body or b"I" in body:
        return None
    check_effort(body)
    written = _parse(body.decode())
    dt, fields = written["dt"], written["fields"]
    if codec == PLAIN_CODEC:
        fields = {name: [None, *column] for name, column in fields.items()}
    flat = len(fields) + 1
    if (
        body.count(b'"') != 2 * (flat + 1)
        or body.count(b"[") != flat
        or body.count(b"{") != 2
        or len(fields) > MAX_FIELDS
        or n * len(fields) > MAX_BATCH_VALUES
        or not all(map(_is_field, fields))
        or any(len(column) != n + 1 for column in fields.values())
        or len(dt) != n
        or set(map(type, dt)) != {int}
        or dt[0] != 0
        or (n > 1 and min(dt[1:]) < 0)
        or sum(dt) >= MAX_BATCH_SPAN_US
    ):
        return None
    return dt, fields


def _numbers(run: Sequence[_Open], names: Sequence[str]) -> Block | None:
    """The samples of batches of the same fields; None where one holds what no batch may."""
    lengths = np.array([len(one.times_us) + 1 for one in run])
    columns: dict[str, Column] = {}
    for name in names:
        written = [one.columns[name] for one in run]
        column = _column(written, lengths)
        if column is None:
            return None
        columns[name] = column
    times = np.fromiter(chain.from_iterable(one.times_us for one in run), dtype=np.int64)
    return Block(times, columns)


def _column(written: Sequence[list[Any]], lengths: NDArray[np.int64]) -> Column | None:
    parts: list[tuple[Column | None, int]] = []
    at = 0
    for is_plain, group in groupby(written, key=lambda column: column[0] is None):
        several = list(group)
        its_lengths = lengths[at : at + len(several)]
        at += len(several)
        values = _from_values(several) if is_plain else _from_steps(several, its_lengths)
        if values is None:
            return None
        parts.append((values, len(values)))
    return parts[0][0] if len(parts) == 1 else joined(parts)


def _from_values(written: Sequence[list[Any]]) -> Column | None:
    """Columns of numbers and null as they are, behind one another; None where one is not within 64 bits,
    which is more than a batch may hold, or a float that only the contract tells apart from that."""
    try:
        column = column_of(list(chain.from_iterable(values[1:] for values in written)), numeric=True)
    except OverflowError:
        return None
    # NaN, which is null here, is on no side of a bound.
    return None if column.dtype != np.float64 or (np.abs(column) >= _OF_64_BITS).any() else column


def _from_steps(written: Sequence[list[Any]], lengths: NDArray[np.int64]) -> Column | None:
    """Columns of decimals, first value and steps, behind one another; None where one breaks a bound.

    All are summed at once, and what was reached before each batch is taken off again. That is exact
    even where the sum of all passes 64 bits: it is so modulo 2**64, and no step that is allowed leads
    from a value that is allowed to one that 64 bits do not hold.
    """
    steps = np.array(list(chain.from_iterable(written)))
    if steps.dtype != np.int64:
        return None
    starts = np.cumsum(lengths) - lengths
    decimals = steps[starts]
    if decimals.min() < 0 or decimals.max() >= len(_SCALES):
        return None
    steps[starts] = 0
    if steps.max() >= 2 * EXACT or steps.min() <= -2 * EXACT:
        return None
    sums = np.cumsum(steps)
    whole = np.delete(sums - np.repeat(sums[starts], lengths), starts)
    if whole.max() >= EXACT or whole.min() <= -EXACT:
        return None
    values: Column = whole / np.repeat(_SCALES[decimals], lengths - 1)
    return values


@lru_cache(maxsize=4 * MAX_FIELDS)
def _is_field(name: str) -> bool:
    try:
        check_field(name)
    except ContractError:
        return False
    return True


def _plain(value: Mapping[str, Any]) -> Value:
    """An attribute value, numbers as int where they are; the contract refuses what else there is."""
    ((kind, content),) = value.items()
    if kind == "N":
        return int(content) if content.lstrip("-").isdecimal() else float(content)
    text: Value = content
    return text
