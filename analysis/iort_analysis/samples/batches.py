"""Stored batches to blocks of samples.

`iort_contract` checks every batch and decodes it to lists. Batches of steps alone, which nearly all are, are
decoded here many at a time by numpy, without reading their JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, groupby
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import EMPTY, Block, column_of, join, ordered
from iort_contract.checks import check_field, shown
from iort_contract.codec import CODEC, EXACT, SCALES
from iort_contract.dynamodb import plain
from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_BATCH_VALUES, MAX_FIELDS, ContractError
from iort_contract.messages.batch import (
    Batch,
    BatchId,
    Envelope,
    batch_id,
    decode_batch,
    decode_envelope,
    read_envelope,
)
from iort_contract.tables import BATCH, NONFINITE, SAMPLES

# Many batches at once, straight from the bytes of their JSON to numpy's columns.
#
# JSON makes an object of every number, which takes longer than all other decoding. Nearly every batch has
# only steps: integers in lists. Their digits become numbers here by whole arrays. What is written in
# another way or is invalid is left to the contract's decoder, which accepts it or says what is wrong.

_POWERS = np.array(SCALES)
# The digits of the largest number of 53 bits: no sum of two numbers of so many leaves 64 bits.
_MOST_DIGITS = 16
_LATEST_US = EXACT
_COMMA, _MINUS, _COLON, _OPEN, _CLOSE = b",-:[]"
_ZERO = np.uint8(ord("0"))
_Integers: TypeAlias = NDArray[np.int64]


class Steps(NamedTuple):
    """The names of a batch's fields, and its lists, of ``dt`` and of each field: each is ``:[...],``."""

    envelope: Envelope
    names: tuple[bytes, ...]
    lists: bytes


def steps_of(envelope: Envelope) -> Steps | None:
    """The parts of a batch that may have steps only; None for any other form."""
    text = envelope.text
    if envelope.codec != CODEC or b"\\" in text or not text.endswith(b"]}}"):
        return None
    parts = text.split(b'"')
    names = tuple(parts[5::2])
    if parts[:2] + parts[3:5] != [b"{", b"dt", b"fields", b":{"] or len(parts) != 5 + 2 * len(names):
        return None
    if len(names) > MAX_FIELDS or envelope.n * len(names) > MAX_BATCH_VALUES:
        return None
    return Steps(envelope, names, b"".join((parts[2], *parts[6::2]))[:-2] + b",")


def decode_steps(run: Sequence[Steps], wanted: Callable[[str], bool]) -> Block | None:
    """The samples of batches with the same names of fields; None if one of them has another form."""
    try:
        names = [check_field(name.decode()) for name in run[0].names]
        for one in run:
            one.envelope.behind.decode()
    except (ContractError, UnicodeDecodeError):
        return None
    counts = np.fromiter((one.envelope.n for one in run), np.int64)
    # Each list of a field begins with its decimals.
    lengths = np.repeat(counts[:, None], 1 + len(names), axis=1)
    lengths[:, 1:] += 1
    numbers = integers(b"".join(one.lists for one in run), lengths.ravel())
    if numbers is None or len(set(names)) < len(names):
        return None
    ends = np.cumsum(lengths.ravel())
    firsts = (ends - lengths.ravel()).reshape(lengths.shape)
    # The sum of a list without its first number, which is 0 in dt. What passes 64 bits comes back.
    sums: _Integers = np.cumsum(numbers)
    sums -= np.repeat(sums[firsts.ravel()], lengths.ravel())
    decimals = numbers[firsts[:, 1:]]
    if int(sums.max()) >= EXACT or int(sums.min()) <= -EXACT:
        return None
    if decimals.size and (int(decimals.max()) >= len(SCALES) or int(decimals.min()) < 0):
        return None
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    in_dt = np.repeat(firsts[:, 0], counts) + within
    starts = np.fromiter((one.envelope.first_us for one in run), np.int64)
    times = np.repeat(starts, counts) + sums[in_dt]
    spans = sums[firsts[:, 0] + counts - 1]
    if numbers[firsts[:, 0]].any() or int(numbers[in_dt].min()) < 0:
        return None
    if int(spans.max()) >= MAX_BATCH_SPAN_US or int(times.max()) >= _LATEST_US:
        return None
    columns = {}
    for place, name in enumerate(names):
        if wanted(name):
            whole = sums[np.repeat(firsts[:, 1 + place] + 1, counts) + within]
            columns[name] = whole / np.repeat(_POWERS[decimals[:, place]], counts)
    return Block(times, columns)


def integers(lists: bytes, lengths: _Integers) -> _Integers | None:
    """The integers of lists of these lengths, each written as ``:[1,-2,3],``; None for any other form."""
    text = np.frombuffer(lists, dtype=np.uint8)
    opens, closes = np.flatnonzero(text == _OPEN), np.flatnonzero(text == _CLOSE)
    if len(opens) != len(lengths) or len(closes) != len(lengths):
        return None
    # `:[` begins the text and follows each `],`.
    if opens[0] != 1 or closes[-1] != len(text) - 2 or (opens[1:] != closes[:-1] + 3).any():
        return None
    if (text[opens - 1] != _COLON).any() or (text[closes + 1] != _COMMA).any():
        return None
    # Characters below "0" wrap.
    values = text - _ZERO
    is_digit = values < 10
    # The first and the last character are no digits.
    edges = np.flatnonzero(is_digit[1:] != is_digit[:-1])
    starts, ends = edges[::2] + 1, edges[1::2]
    before = text[starts - 1]
    is_negative = before == _MINUS
    negative = starts[is_negative]
    before[is_negative] = text[negative - 2]
    after = text[ends + 1]
    # What there is: digits, a minus before some numbers, a comma for each, and the brackets.
    other = len(text) - int(is_digit.sum()) - len(negative) - len(starts) - 3 * len(lengths)
    digits = ends - starts + 1
    if (
        other
        or not len(starts)
        or int((after == _COMMA).sum()) != len(starts) - len(lengths)
        or int((after == _CLOSE).sum()) != len(lengths)
        or not ((before == _COMMA) | (before == _OPEN)).all()
        or int(digits.max()) > _MOST_DIGITS
        or ((values[starts] == 0) & (digits > 1)).any()
        or (np.diff(np.searchsorted(starts, opens), append=len(starts)) != lengths).any()
    ):
        return None
    numbers: _Integers = values[ends].astype(np.int64)
    longer = np.flatnonzero(digits > 1)
    for place in range(1, int(digits.max())):
        numbers[longer] += values[ends[longer] - place] * np.int64(10**place)
        longer = longer[digits[longer] > place + 1]
    np.negative(numbers, out=numbers, where=is_negative)
    return numbers


# The attributes of a stored item that its samples need.
ATTRIBUTES = ("v", BATCH, SAMPLES, NONFINITE, "codec", "samples")
# So many of what cannot be read are named.
MOST_NAMED = 20
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
    for run in _runs(_read(items, refused)):
        steps = [one for one in run if isinstance(one, Steps) and (messages or not one.envelope.behind)]
        block = decode_steps(steps, wanted) if len(steps) == len(run) else None
        if block is None:
            envelopes = (one.envelope if isinstance(one, Steps) else one for one in run)
            block = join(list(_by_contract(envelopes, refused, wanted, messages=messages)))
        found.append(block)
    return Part(join(found), start_us(items[-1]) if items else 0)


def batches_of(items: Iterable[Item], wanted: Wanted = lambda _name: True) -> Iterator[Batch]:
    """Stored items as batches of the fields that are ``wanted``; what is not a batch is left out."""
    for item in items:
        with suppress(ContractError):
            batch = decode_batch(plain(item))
            columns = {name: column for name, column in batch.columns.items() if wanted(name)}
            yield replace(batch, columns=columns)


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


def _read(items: Iterable[Item], refused: RefusedItems) -> Iterator[Steps | Envelope]:
    for item in items:
        try:
            envelope = read_envelope(plain({name: item[name] for name in ATTRIBUTES if name in item}))
        except ContractError as error:  # noqa: PERF203 - each batch is refused by itself
            refused.add(error, item.get(BATCH, {}).get("S", "") if isinstance(item.get(BATCH), dict) else "")
        else:
            yield steps_of(envelope) or envelope


def _runs(batches: Iterable[Steps | Envelope]) -> Iterator[list[Steps | Envelope]]:
    """Batches of the same fields one after the other, as many as are decoded together."""
    run: list[Steps | Envelope] = []
    names: tuple[bytes, ...] | None = None
    size = 0
    for batch in batches:
        own = batch.names if isinstance(batch, Steps) else None
        if run and (own != names or size > _TOGETHER_BYTES):
            yield run
            run, size = [], 0
        names = own
        size += len(batch.lists) if isinstance(batch, Steps) else 0
        run.append(batch)
    if run:
        yield run


def _by_contract(
    envelopes: Iterable[Envelope], refused: RefusedItems, wanted: Wanted, *, messages: bool
) -> Iterator[Block]:
    """The samples of batches in any form, one at a time."""
    batches: list[Batch] = []
    for envelope in envelopes:
        try:
            if messages or not (envelope.serialized or envelope.about):
                batches.append(decode_envelope(envelope))
        except ContractError as error:  # noqa: PERF203 - each batch is refused by itself
            refused.add(error, envelope.id)
    for _, same in groupby(batches, key=lambda batch: list(batch.columns)):
        group = list(same)
        columns = {
            name: column_of(list(chain.from_iterable(batch.columns[name] for batch in group)))
            for name in group[0].columns
            if wanted(name)
        }
        times = np.fromiter(chain.from_iterable(batch.times_us for batch in group), dtype=np.int64)
        yield Block(times, columns)
