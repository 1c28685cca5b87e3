"""Stored batches to blocks of samples.

`iort_contract` checks every batch and decodes it to lists. Columns of steps are decoded here too, with numpy
and many batches at a time: the same checks, twice as fast. Batches of steps alone are not even read as JSON
(`iort_analysis.samples.steps`).
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, groupby, repeat
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import EMPTY, Block, Column, column_of, join, joined, ordered
from iort_analysis.samples.steps import Written, decoded, written
from iort_contract.checks import shown
from iort_contract.codec import SCALES, check_sums, decimals_of, not_integers, plain_values
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import (
    Batch,
    BatchId,
    Envelope,
    Opened,
    batch_id,
    decode_opened,
    open_envelope,
    read_envelope,
)
from iort_contract.tables import BATCH, NONFINITE, SAMPLES

# The attributes of a stored item that its samples need.
ATTRIBUTES = ("v", BATCH, SAMPLES, NONFINITE, "codec", "samples")
# So many of what cannot be read are named.
MOST_NAMED = 20
_SCALES = np.array(SCALES)
# The arrays of so much text fit in a processor's cache, and malloc keeps memory for them.
_TOGETHER_BYTES = 40 * 1024
Item = Mapping[str, Any]
Wanted = Callable[[str], bool]


class RefusedItems:
    """Counts what cannot be read of a ``topic``, and keeps the first ones by name: topic, time and reason."""

    def __init__(self, topic: str = "") -> None:
        self.count, self.topic = 0, topic
        self.named: list[str] = []

    @property
    def reason(self) -> str:
        """The first one; empty if there is none."""
        return next(iter(self.named), "")

    def add(self, error: Exception, what: object) -> None:
        """Count one: the batch with this key, or something else."""
        self.count += 1
        if len(self.named) < MOST_NAMED:
            try:
                one = what if isinstance(what, BatchId) else batch_id(what)
                at = np.datetime_as_string(np.datetime64(one.t_us, "us"))
                what = f"{at}Z ({one})"
            except ContractError:
                what = what if isinstance(what, str) else shown(what)
            self.named.append(f"{self.topic} at {what}: {error}".lstrip())


class Part(NamedTuple):
    """The samples of some batches, and the time at which the last of these batches starts."""

    block: Block
    start_us: int


def blocks(
    pages: Iterable[Sequence[Item]], refused: RefusedItems, wanted: Wanted = lambda _name: True
) -> Iterator[Block]:
    """The samples of pages of items, in order of time, with the fields that are ``wanted``."""
    return in_order(part(items, refused, wanted) for items in pages if items)


def part(
    items: Sequence[Item],
    refused: RefusedItems,
    wanted: Wanted = lambda _name: True,
    *,
    messages: bool = True,
) -> Part:
    """The samples of a page of items, in the order of its batches. Without ``messages``, ROS messages
    are skipped."""
    found: list[Block] = []
    for run in _runs(_written(items, refused)):
        steps = [one for one in run if isinstance(one, Written) and (messages or not one.envelope.behind)]
        block = decoded(steps, wanted) if len(steps) == len(run) else None
        if block is None:
            envelopes = (one.envelope if isinstance(one, Written) else one for one in run)
            block = _block(_opened(envelopes, refused, messages=messages), refused, wanted)
        found.append(block)
    return Part(join(found), start_us(items[-1]) if items else 0)


def in_order(parts: Iterable[Part]) -> Iterator[Block]:
    """The samples in order of time. Batches may overlap in time, after a clock was set back or with several
    publishers on a topic."""
    held = EMPTY
    for block, last_us in parts:
        if not len(block.times_us):
            continue
        both = ordered(join([held, block]))
        # A later batch may still hold samples from its start on.
        final = int(np.searchsorted(both.times_us, last_us, side="left"))
        held = both.take(slice(final, None))
        if final:
            yield both.take(slice(final))
    if len(held.times_us):
        yield held


def start_us(item: Item) -> int:
    """The time at which a stored batch starts; 0 if its key is invalid."""
    try:
        return batch_id(item[BATCH]["S"]).t_us
    except (ContractError, KeyError, TypeError):
        return 0


def _written(items: Iterable[Item], refused: RefusedItems) -> Iterator[Written | Envelope]:
    for item in items:
        try:
            envelope = read_envelope(plain({name: item[name] for name in ATTRIBUTES if name in item}))
        except ContractError as error:  # noqa: PERF203 - each batch is refused by itself
            refused.add(error, item.get(BATCH, {}).get("S", "") if isinstance(item.get(BATCH), dict) else "")
        else:
            yield written(envelope) or envelope


def _runs(batches: Iterable[Written | Envelope]) -> Iterator[list[Written | Envelope]]:
    """Batches of the same fields one after the other, as many as are decoded together."""
    run: list[Written | Envelope] = []
    names: tuple[bytes, ...] | None = None
    size = 0
    for batch in batches:
        own = batch.names if isinstance(batch, Written) else None
        if run and (own != names or size > _TOGETHER_BYTES):
            yield run
            run, size = [], 0
        names = own
        size += len(batch.lists) if isinstance(batch, Written) else 0
        run.append(batch)
    if run:
        yield run


def _opened(envelopes: Iterable[Envelope], refused: RefusedItems, *, messages: bool) -> Iterator[Opened]:
    for envelope in envelopes:
        try:
            batch = open_envelope(envelope)
        except ContractError as error:
            refused.add(error, BatchId(envelope.first_us, envelope.boot, envelope.seq))
            continue
        if messages or (batch.serialized is None and not batch.about):
            yield batch


def _block(batches: Iterable[Opened], refused: RefusedItems, wanted: Wanted) -> Block:
    parts: list[Block] = []
    for (names, is_serialized), same in groupby(batches, key=_form):
        run = list(same)
        try:
            if not is_serialized:
                parts.append(decode_together(run, list(filter(wanted, names))))
                continue
        except ContractError:
            # The lists tell which batch is invalid.
            pass
        parts += decode_each(run, refused, wanted)
    return join(parts)


def _form(batch: Opened) -> tuple[list[str], bool]:
    return list(batch.written), batch.serialized is not None


def decode_each(run: Iterable[Opened], refused: RefusedItems, wanted: Wanted) -> Iterator[Block]:
    """The list back end: one batch at a time."""
    batches: list[Batch] = []
    for one in run:
        try:
            batches.append(decode_opened(one))
        except ContractError as error:  # noqa: PERF203 - each batch is refused by itself
            refused.add(error, BatchId(one.times_us[0], one.boot, one.seq))
    for _, same in groupby(batches, key=lambda batch: list(batch.columns)):
        group = list(same)
        columns = {
            name: column_of(list(chain.from_iterable(batch.columns[name] for batch in group)))
            for name in group[0].columns
            if wanted(name)
        }
        times = np.fromiter(chain.from_iterable(batch.times_us for batch in group), dtype=np.int64)
        yield Block(times, columns)


def decode_together(run: Sequence[Opened], names: Sequence[str]) -> Block:
    """The numpy back end: batches of the same fields; raises `ContractError` if any is invalid."""
    counts = [len(batch.times_us) for batch in run]
    times_us = chain.from_iterable(batch.times_us for batch in run)
    times = np.fromiter(times_us, dtype=np.int64, count=sum(counts))
    return Block(times, {name: _column(name, [b.written[name] for b in run], counts) for name in names})


def _column(name: str, written: Sequence[Any], counts: Sequence[int]) -> Column:
    """A field's values from its column in each batch of ``counts`` samples."""
    decimals = list(map(decimals_of, repeat(name), written, counts))
    if None not in decimals:
        return _from_steps(name, written)
    parts: list[Column] = []
    for is_plain, group in groupby(zip(decimals, written, strict=True), key=lambda pair: pair[0] is None):
        some = [column for _, column in group]
        if is_plain:
            parts.append(column_of(list(chain.from_iterable(plain_values(name, c) for c in some))))
        else:
            parts.append(_from_steps(name, some))
    return joined([(part, len(part)) for part in parts])


def _from_steps(name: str, written: Sequence[list[Any]]) -> Column:
    """Columns of decimals, first value and steps, as one column of values.

    numpy sums all of them at once; then each column loses the sum of those before it. int64 sums are exact
    modulo 2**64, and a valid column's sums stay within 53 bits.
    """
    try:
        # An array takes integers and booleans only, and is faster than numpy at that.
        steps = np.frombuffer(array("q", list(chain.from_iterable(written))), dtype=np.int64)
    except (TypeError, OverflowError) as error:
        raise not_integers(name) from error
    lengths = np.fromiter(map(len, written), dtype=np.int64)
    starts = np.cumsum(lengths) - lengths
    decimals = steps[starts]
    steps[starts] = 0
    # A larger step leads out of 53 bits, and might lead back through 64.
    check_sums(name, int(steps.min()) // 2, int(steps.max()) // 2)
    sums: NDArray[np.int64] = np.cumsum(steps)
    whole = np.delete(sums - np.repeat(sums[starts], lengths), starts)
    check_sums(name, int(whole.min()), int(whole.max()))
    values: Column = whole / np.repeat(_SCALES[decimals], lengths - 1)
    return values
