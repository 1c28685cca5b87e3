"""Many batches at once, straight from the bytes of their JSON to numpy's columns.

JSON makes an object of every number, which takes longer than all other decoding. Nearly every batch has only
steps: integers in lists. Their digits become numbers here by whole arrays. What is written in another way or
is invalid is left to the contract's decoder, which accepts it or says what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Block
from iort_contract.checks import check_field
from iort_contract.codec import CODEC, EXACT, SCALES
from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_BATCH_VALUES, MAX_FIELDS, ContractError
from iort_contract.messages.batch import Envelope

_SCALES = np.array(SCALES)
# The digits of the largest number of 53 bits: no sum of two numbers of so many leaves 64 bits.
_MOST_DIGITS = 16
_LATEST_US = EXACT
_COMMA, _MINUS, _COLON, _OPEN, _CLOSE = b",-:[]"
_ZERO = np.uint8(ord("0"))
_Integers: TypeAlias = NDArray[np.int64]


class Written(NamedTuple):
    """The names of a batch's fields, and its lists, of ``dt`` and of each field: each is ``:[...],``."""

    envelope: Envelope
    names: tuple[bytes, ...]
    lists: bytes


def written(envelope: Envelope) -> Written | None:
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
    return Written(envelope, names, b"".join((parts[2], *parts[6::2]))[:-2] + b",")


def decoded(run: Sequence[Written], wanted: Callable[[str], bool]) -> Block | None:
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
            columns[name] = whole / np.repeat(_SCALES[decimals[:, place]], counts)
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
