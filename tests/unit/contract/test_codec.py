"""The column codec restores every value bit for bit and refuses columns that no encoder writes."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import struct
import tracemalloc
import zlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iort_contract.catalog.streams import AGENT_FIELDS, RTT_FIELDS
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.checks import wire_column
from iort_contract.codec import DICTIONARY, check_effort, packed, unpacked
from iort_contract.limits import MAX_BATCH_VALUES, ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from tests.examples import examples

BOOT = "0123abcd"
EDGE = 2**53

finite = st.floats(allow_nan=False, allow_infinity=False)
integers = st.integers(-(2**63), 2**64 - 1)
decimals = st.builds(lambda whole, places: whole / 10**places, st.integers(-EDGE, EDGE), st.integers(0, 25))
singles = st.floats(width=32, allow_nan=False, allow_infinity=False)
near_the_edge = st.integers(EDGE - 3, EDGE + 3) | st.integers(-EDGE - 3, 3 - EDGE)
odd = st.none() | st.booleans() | st.text(max_size=3)


@st.composite
def columns(draw):
    """Columns of one kind, of two kinds and of any mixture."""
    n = draw(st.integers(1, 30))
    places = draw(st.integers(0, 6))
    reading = st.integers(-(10**6), 10**6).map(lambda whole: whole / 10**places)
    kinds = st.sampled_from([finite, integers, decimals, singles, near_the_edge, odd, reading])
    kind = st.one_of(draw(st.lists(kinds, min_size=1, max_size=2)))
    return draw(st.lists(kind, min_size=n, max_size=n))


def bits(values):
    """Type and content of each value; all 64 bits of a float."""
    return [(type(v), struct.pack("<d", v) if type(v) is float else v) for v in values]


@examples(300)
@given(columns())
@example([0.1, 0.2, 0.30000000000000004])
@example([1e300, 1, -1e300])
@example([5e-324, 1e-22, 1.5e-22])
@example([2.5, 3, -0.5, 2.0**53 - 1])
@example([float(EDGE), 0.5])
@example([EDGE - 1, 1 - EDGE])
@example([0.1] * 9 + [0.125] + [0.1] * 9)
def test_a_column_is_restored_bit_for_bit(column):
    values, _ = wire_column("a", column)
    written = json.loads(json.dumps(packed(values)))
    assert bits(unpacked("a", written, len(values))) == bits(values)
    assert bits(unpacked("a", [None, *values], len(values))) == bits(values)


# Fields that came after the dictionary was frozen.
NEWER = {"thread_errors"}
FROZEN = "71f73f6da111bb52e14b827789e70220e1689946c9378dbab0ed3390b2cf0b95"


def test_the_compression_dictionary_stays_the_same():
    assert hashlib.sha256(DICTIONARY).hexdigest() == FROZEN
    names = set(re.findall(r'"(\w+)":', DICTIONARY.decode()))
    assert {
        *VESC_FIELDS,
        *AGENT_FIELDS,
        *RTT_FIELDS.values(),
    } - NEWER <= names


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        ([5, 7, 4], [0, 5, 2, -3]),
        ([2.5, 3, 2.25], [2, 250, 50, -75]),
        ([12.1] * 3, [1, 121, 0, 0]),
        ([1e-05, 2e-05], [5, 1, 1]),
        ([0.5, None], [None, 0.5, None]),
        ([True, False], [None, True, False]),
        ([EDGE, 1], [None, EDGE, 1]),
        ([5 / 3, 0.5], [None, 5 / 3, 0.5]),
    ],
)
def test_a_column_is_encoded_as_documented(column, expected):
    assert bits(packed(column)) == bits(expected)


def message_of(*fields, n=2):
    """A message of this codec with the given encoded columns."""
    body = {"dt": [0] + [5] * (n - 1), "fields": {f"f{i}": column for i, column in enumerate(fields)}}
    return enveloped(json.dumps(body).encode(), n)


def enveloped(body, n):
    """A valid envelope with any body."""
    deflater = zlib.compressobj(zdict=DICTIONARY)
    samples = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    good = json.loads(encode_batch(Batch(BOOT, 0, [0], {"a": [1]})))
    return {**good, "n": n, "samples": samples}


# Encoded columns of two values, and the error that each must give.
WRONG = [
    ([], "must have 2 values"),
    ([0, 1], "must have 2 values"),
    ({"0": 1}, "must have 2 values"),
    ([-1, 1, 2], "decimals must be 0 to 22, got -1"),
    ([23, 1, 2], "decimals must be 0 to 22, got 23"),
    ([1.0, 1, 2], "decimals must be 0 to 22, got 1.0"),
    ([True, 1, 2], "decimals must be 0 to 22, got True"),
    (["1", 1, 2], "decimals must be 0 to 22, got '1'"),
    ([1, 1.0, 2], "must be integers"),
    ([1, True, 2], "must be integers"),
    ([1, None, 2], "must be integers"),
    ([1, "1", 2], "must be integers"),
    ([0, EDGE, 0], "must fit in 53 bits"),
    ([0, -EDGE, 0], "must fit in 53 bits"),
    ([0, 1, EDGE - 1], "must fit in 53 bits"),
    ([0, 1, 10**4000], "must fit in 53 bits"),
    ([0, 10**400, 1.5], "must be integers"),
    ([0, [1], [2]], "must be integers"),
    ([None, 1, [2]], "must hold numbers"),
    ([None, 1, float("1e999")], "Infinity"),
]


@pytest.mark.parametrize(("column", "named"), WRONG)
def test_columns_that_no_encoder_writes_are_refused(column, named):
    message = message_of(column)
    with pytest.raises(ContractError, match=re.escape(named)):
        decode_batch(message)


def test_a_sum_that_overflows_64_bits_is_refused():
    with pytest.raises(ContractError, match="must fit in 53 bits"):
        decode_batch(message_of([0, 1, *[2**62] * 4, 1], n=6))


@pytest.mark.parametrize("first", ["x" * 1_000_000, [1] * 10_000])
def test_a_column_of_texts_or_lists_is_never_summed(first):
    """Adding 100 characters to a long text one by one would take 100 times its memory."""
    message = message_of([0, first, *[first[:1]] * 99], n=100)
    tracemalloc.start()
    try:
        with pytest.raises(ContractError, match="must be integers"):
            decode_batch(message)
        assert tracemalloc.get_traced_memory()[1] < 20 * len(json.dumps(first))
    finally:
        tracemalloc.stop()


def test_columns_are_bounded_by_their_inflated_size():
    """A step of one character becomes a whole value, so the limit is half the text's."""
    with pytest.raises(ContractError, match="inflate to at most 4194304 bytes"):
        decode_batch(message_of(*[[1] * 50_001] * 45, n=50_000))
    batch = Batch(BOOT, 0, list(range(1_100)), {"a": ["x" * 4096] * 1_100})
    with pytest.raises(ContractError, match="columns of a batch must be at most 4194304 bytes"):
        encode_batch(batch)


# The complexity guard: the largest allowed batch is read; a more expensive one is refused before parsing.

MOST = MAX_BATCH_VALUES


def full(fields, value):
    n = MOST // fields
    return Batch(BOOT, 0, range(n), {f"f{i}": [value] * n for i in range(fields)})


@pytest.mark.parametrize(
    ("fields", "value"),
    [
        (1, 0),
        (1, -1.2345678901234567e-300),
        (1, '{"a":[1,2,3]}'),
        (1, 'say "yes, [no]" \\ \\" {'),
        (50, 0.125),
        (512, 2**63),
        (500, None),
        (512, "a,b"),
    ],
)
def test_the_largest_allowed_number_of_values_is_read(fields, value):
    batch = full(fields, value)
    assert decode_batch(encode_batch(batch)).columns == batch.columns


def test_the_longest_texts_are_read_with_any_characters():
    texts = ["," * 4096, '"' * 4096, "\\" * 4096, '\\"' * 2048, "[" * 4096, "{" * 4096, "é" * 4096]
    batch = Batch(BOOT, 0, range(7 * 20), {"a": texts * 20})
    assert decode_batch(encode_batch(batch)).columns == batch.columns


def test_columns_with_extra_spaces_are_read():
    columns = {
        "dt": [0] + [1] * 9_999,
        "fields": {"a.b": [None, *[0.5] * 10_000], "c": [None, *["x", None] * 5_000]},
    }
    body = json.dumps(columns, separators=("," + " " * 9, ": ")).encode()
    assert len(body) > 2 * MOST
    assert len(decode_batch(enveloped(body, 10_000)).times_us) == 10_000
    # The columns are one line; the lines after it describe messages.
    with pytest.raises(ContractError, match="not JSON"):
        decode_batch(enveloped(json.dumps(columns, indent=8).encode(), 10_000))


@pytest.mark.parametrize(("samples", "fields"), [(MOST // 2 + 1, 2), (98, 512)])
def test_encoder_and_decoder_refuse_too_many_values(samples, fields):
    said = f"at most {MOST} values, got {samples} samples of {fields} fields"
    with pytest.raises(ContractError, match=said):
        encode_batch(Batch(BOOT, 0, range(samples), {f"f{i}": [1] * samples for i in range(fields)}))
    columns = b",".join(b'"f%d":[%s0]' % (i, b"0," * (samples - 1)) for i in range(fields))
    body = b'{"dt":[0%s],"fields":{%s}}' % (b",1" * (samples - 1), columns)
    with pytest.raises(ContractError, match=said):
        decode_batch(enveloped(body, samples))


EXPENSIVE = {
    "values": b'{"dt":[0],"fields":{"a":[' + b"0," * 2_000_000 + b"0]}}",
    "columns": b'{"dt":[0],"fields":{' + b",".join(b'"f%d":[0]' % i for i in range(20_000)) + b"}}",
    "names": b'{"dt":[0],"fields":{' + b",".join(b'"f%d":0' % i for i in range(200_000)) + b"}}",
    "lists": b'{"dt":[0],"fields":{"a":[' + b"[]," * 1_000_000 + b"0]}}",
    "lists in lists": b'{"dt":[0],"fields":{"a":[' + (b"[" * 190 + b"]" * 190 + b",") * 5_000 + b"0]}}",
    "objects": b'{"dt":[0],"fields":{"a":[' + b"{}," * 1_000_000 + b"0]}}",
    "texts": b'{"dt":[0],"fields":{"a":[' + b'"",' * 1_000_000 + b"0]}}",
    "texts behind an escape": b'{"dt":[0],"fields":{"a":["\\"",' + b'"",' * 1_000_000 + b"0]}}",
    "long integers": b'{"dt":[0],"fields":{"a":[' + (b"9" * 4_200 + b",") * 900 + b"0]}}",
    "long floats": b'{"dt":[0],"fields":{"a":[' + (b"0." + b"9" * 4_200 + b",") * 900 + b"0]}}",
    "white space": b'{"dt":[0],' + b" " * 4_000_000 + b'"fields":{"a":[0]}}',
    "no JSON": b"[" * 4_000_000,
}


@pytest.mark.parametrize("body", EXPENSIVE.values(), ids=EXPENSIVE)
def test_an_expensive_body_is_refused_before_it_is_parsed(body):
    with pytest.raises(ContractError, match=r"samples must (be columns|hold at most)"):
        check_effort(body)
    with pytest.raises(ContractError, match="samples must"):
        decode_batch(enveloped(body, 1))


def test_a_field_name_has_at_most_1024_characters():
    longest = "a" + ".b" * 511 + "c"
    batch = Batch(BOOT, 0, [0], {longest: [1]})
    assert decode_batch(encode_batch(batch)) == batch
    for name in (longest + "d", "a" + ".b" * 1_000_000):
        with pytest.raises(ContractError, match="at most 1024 characters"):
            encode_batch(Batch(BOOT, 0, [0], {name: [1]}))
        with pytest.raises(ContractError, match="at most 1024 characters"):
            decode_batch(enveloped(b'{"dt":[0],"fields":{"%s":[1]}}' % name.encode(), 1))
