"""Hypothesis strategies for the contract's messages, and strict comparison of the results."""

from __future__ import annotations

import json
import math

from hypothesis import strategies as st

from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_FIELDS, MAX_SAMPLES, ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.messages.live import LiveSample, decode_live, encode_live

LIMIT_US = 2**53 - 1
BOOT = "0123abcd"

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}(\.[A-Za-z0-9_]{1,4}){0,2}", fullmatch=True)
boots = st.from_regex(r"[0-9a-f]{8,32}", fullmatch=True)
seqs = st.integers(0, 2**53)
times = st.integers(-LIMIT_US, LIMIT_US)
EDGES = [-0.0, 5e-324, -2.2e-308, 1e308, 2.0**53 - 1, 2.0**53, -(2.0**53), 1e15 + 0.5, 3.0, 1e-7]
finite = st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(EDGES)
integers = st.integers(-(2**63), 2**64 - 1) | st.sampled_from([-(2**63), 2**63, 2**64 - 1, 2**53 + 1])
# st.text leaves out surrogates: valid Unicode text has no surrogates.
values = st.none() | st.booleans() | integers | finite | st.text(max_size=20)


@st.composite
def batches(draw, kinds=values):
    # Several samples may have the same time.
    offsets = draw(st.lists(st.integers(0, MAX_BATCH_SPAN_US - 1) | st.integers(0, 3), max_size=12))
    first = draw(st.integers(0, LIMIT_US - MAX_BATCH_SPAN_US) | st.just(0))
    n = 1 + len(offsets)
    # Columns of one type, as in recordings, and columns of any mixture.
    column = st.one_of(
        st.lists(kinds, min_size=n, max_size=n),
        st.lists(finite, min_size=n, max_size=n),
        st.lists(integers, min_size=n, max_size=n),
    )
    columns = draw(st.dictionaries(names, column, max_size=5))
    steps = [first] + [first + offset for offset in sorted(offsets)]
    return Batch(draw(boots), draw(seqs), steps, columns, draw(st.integers(0, 1000)))


def same(one, other):
    """Equal and of the same type: True is not 1; only a whole float may become an integer."""
    if type(one) is float and type(other) is int:
        return one == other
    return type(one) is type(other) and one == other


def strict(text):
    """Parse standard JSON, without NaN and Infinity."""

    def refuse(name):
        raise AssertionError(f"{name} in {text[:100]!r}")

    return json.loads(text, parse_constant=refuse)


def nulled(value):
    return None if type(value) is float and not math.isfinite(value) else value


anything = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf]) | values

GOOD = Batch(BOOT, 4, [0, 5], {"speed": [1.5, 2.5]}, 0)
GOOD_LIVE = LiveSample(BOOT, 4, 0, 5, {"speed": 1.5}, 0)
MOST_NONFINITE = MAX_SAMPLES * MAX_FIELDS

BAD_HEADERS = [
    ({"boot": "0123ABCD"}, "boot"),
    ({"boot": "0123abc"}, "boot"),
    ({"boot": "0" * 33}, "boot"),
    ({"boot": "0123abcd\n"}, "boot"),
    ({"boot": None}, "boot"),
    ({"seq": -1}, "seq"),
    ({"seq": 2**53 + 1}, "seq"),
    ({"seq": True}, "seq"),
    ({"seq": 1.0}, "seq"),
    ({"seq": "4"}, "seq"),
    ({"nonfinite": -1}, "nonfinite"),
    ({"nonfinite": MOST_NONFINITE + 1}, "nonfinite"),
]


def decode_or_refuse(decoder, message):
    """Decode, or raise `ContractError`; a decoded message must be one that the encoder accepts."""
    try:
        taken = decoder(message)
    except ContractError as error:
        str(error).encode()  # the error can be logged, whatever the message held
        return
    if isinstance(taken, Batch):
        assert decode_batch(encode_batch(taken)) == taken
    elif isinstance(taken, LiveSample):
        assert decode_live(encode_live(taken)) == taken


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=10),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)
# More levels of nesting than a parser can follow.
DEEP = 100_000
