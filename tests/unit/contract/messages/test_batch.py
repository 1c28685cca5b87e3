"""Batches are decoded bit for bit as they were encoded; the encoder refuses invalid batches."""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import fields, replace
from decimal import Decimal

import pytest
from hypothesis import assume, given

from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.codec import inflate
from iort_contract.limits import MAX_BATCH_SPAN_US, MAX_MESSAGE_BYTES, MAX_SAMPLES, ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch, split_batch
from iort_contract.messages.live import encode_live
from tests.unit.contract.contract_values import (
    BAD_HEADERS,
    BOOT,
    GOOD,
    GOOD_LIVE,
    MOST_NONFINITE,
    anything,
    batches,
    nulled,
    same,
    strict,
)


def body_of(envelope):
    return inflate(envelope["samples"], envelope["codec"])


def stored(message):
    """The message as an item of the telemetry table, read with boto3: numbers are Decimals."""
    item = json.loads(message, parse_int=Decimal, parse_float=Decimal)
    cloud = {"topic": "dt/iort/car/vesc", "received_ms": Decimal(1), "expires_s": Decimal("1.7E+9")}
    return dict(item, **cloud)


def assert_same_batch(decoded, batch):
    assert replace(decoded, columns={}) == replace(batch, columns={})
    assert list(decoded.columns) == list(batch.columns)
    for name, column in batch.columns.items():
        assert len(decoded.columns[name]) == len(column)
        assert all(map(same, column, decoded.columns[name])), name


@given(batches())
def test_batch_round_trip(batch):
    message = encode_batch(batch)
    assert_same_batch(decode_batch(message), batch)
    assert_same_batch(decode_batch(message.decode()), batch)
    assert_same_batch(decode_batch(json.loads(message)), batch)
    assert_same_batch(decode_batch(stored(message)), batch)
    assert batch.t_us == batch.times_us[0]


@given(batches())
def test_encoding_again_gives_the_same_message(batch):
    message = encode_batch(batch)
    assert encode_batch(decode_batch(message)) == message


@pytest.mark.parametrize("n", [1, 2, 50, 1000])
def test_a_batch_of_a_drive_is_decoded_as_it_was_encoded(n):
    columns = {name: [i / 7 for i in range(n)] for name in VESC_FIELDS}
    batch = Batch(BOOT, 7, [i * 999 for i in range(n)], columns)
    assert decode_batch(encode_batch(batch)) == batch


def test_whole_floats_become_integers_on_the_wire():
    batch = Batch(BOOT, 0, [0], {"a": [3.0], "b": [-0.0], "c": [1e300], "d": [True], "e": [0.5]})
    message = encode_batch(batch)
    assert body_of(json.loads(message)) == (
        b'{"dt":[0],"fields":{"a":[0,3],"b":[0,0],"c":[null,1e+300],"d":[null,true],"e":[1,5]}}'
    )
    assert list(map(type, (c[0] for c in decode_batch(message).columns.values()))) == [
        int, int, float, bool, float,
    ]  # fmt: skip


def test_the_envelope_names_its_content():
    batch = Batch(BOOT, 3, [1_000, 1_250, 1_900], {"speed": [1, 2.5, None]})
    envelope = json.loads(encode_batch(batch))
    assert {key: envelope[key] for key in envelope if key != "samples"} == {
        "v": 2,
        "batch": f"0000000000001000-{BOOT}-3",
        "n": 3,
        "codec": "steps",
    }
    assert json.loads(body_of(envelope)) == {"dt": [0, 250, 650], "fields": {"speed": [None, 1, 2.5, None]}}


def test_the_envelope_has_nonfinite_only_with_nonfinite_values():
    for count in (0, 3):
        envelope = json.loads(encode_batch(replace(GOOD, nonfinite=count)))
        assert envelope.get("nonfinite", 0) == count
        assert ("nonfinite" in envelope) == bool(count)
        assert decode_batch({**envelope, "nonfinite": count}).nonfinite == count


def test_samples_with_equal_times_keep_their_number_and_order():
    batch = Batch(BOOT, 0, [5, 5, 5, 6], {"a": [3, 1, 2, 0]})
    assert decode_batch(encode_batch(batch)) == batch


@given(batches(kinds=anything))
def test_nonfinite_becomes_null_and_is_counted(batch):
    message = encode_batch(batch)
    strict(body_of(strict(message)))
    expected = {name: list(map(nulled, column)) for name, column in batch.columns.items()}
    new = sum(
        value is None and was is not None
        for name, column in batch.columns.items()
        for value, was in map(lambda *pair: pair, expected[name], column)
    )
    clean = replace(batch, columns=expected, nonfinite=batch.nonfinite + new)
    assert_same_batch(decode_batch(message), clean)


def test_a_float_keeps_all_its_bits():
    numbers = [struct.unpack("<d", struct.pack("<Q", bits))[0] for bits in (1, 2**52 - 1, 0x7FEFFFFFFFFFFFFF)]
    batch = Batch(BOOT, 0, [0, 1, 2], {"x": numbers})
    assert decode_batch(encode_batch(batch)).columns["x"] == numbers


@given(batches())
def test_two_halves_of_a_batch_hold_all_its_samples(batch):
    assume(len(batch.times_us) > 1)
    first, second = split_batch(batch)
    assert (first.seq, second.seq) == (batch.seq, batch.seq + 1)
    assert first.boot == second.boot == batch.boot
    assert first.nonfinite + second.nonfinite == batch.nonfinite
    assert abs(len(first.times_us) - len(second.times_us)) <= 1
    assert [*first.times_us, *second.times_us] == batch.times_us
    assert list(first.columns) == list(second.columns) == list(batch.columns)
    for name, column in batch.columns.items():
        assert [*first.columns[name], *second.columns[name]] == column
    assert_same_batch(decode_batch(encode_batch(first)), first)


def test_one_sample_does_not_split():
    with pytest.raises(ContractError, match="one sample of 1 fields"):
        split_batch(Batch(BOOT, 0, [0], {"a": [1]}))


BAD_VALUES = [
    (2**64, "64 bits"),
    (-(2**63) - 1, "64 bits"),
    (10**5000, "64 bits"),
    ("\ud800", "must be Unicode"),
    ("ok \udfff", "must be Unicode"),
    ("x" * 4097, "4096"),
    (b"bytes", "must hold numbers"),
    ([1], "must hold numbers"),
    ({"a": 1}, "must hold numbers"),
    (Decimal(1), "must hold numbers"),
    (1j, "must hold numbers"),
]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        *BAD_HEADERS,
        ({"times_us": []}, "samples, got 0"),
        ({"times_us": range(MAX_SAMPLES + 1)}, "samples, got 50001"),
        ({"times_us": [5, 0]}, "in order"),
        ({"times_us": [0, 7, 6]}, "in order"),
        ({"times_us": [-1, 0]}, "time must be from 1970 on, got -1 us"),
        ({"times_us": [0, MAX_BATCH_SPAN_US]}, "span"),
        ({"times_us": [2**53, 2**53 + 1]}, "sample time"),
        ({"times_us": [0, 1.0]}, "sample time"),
        ({"times_us": [False, True]}, "sample time"),
        ({"times_us": ["0", "1"]}, "sample time"),
        ({"columns": {"speed": [1]}}, "field speed must have 2 values, got 1"),
        ({"columns": {f"f{i}": [0, 0] for i in range(513)}}, "fields, got 513"),
        ({"columns": {"speed": [math.nan, 0]}, "nonfinite": MOST_NONFINITE}, "nonfinite"),
        ({"columns": {"": [1, 2]}}, "field name"),
        ({"columns": {"a..b": [1, 2]}}, "field name"),
        ({"columns": {"a\n": [1, 2]}}, "field name"),
        ({"columns": {"1a": [1, 2]}}, "field name"),
        ({"columns": {"größe": [1, 2]}}, "field name"),
        ({"columns": {"a٣": [1, 2]}}, "field name"),
        ({"columns": {7: [1, 2]}}, "field name must be .*, got 7"),
    ],
)
def test_an_invalid_batch_is_refused(changed, named):
    with pytest.raises(ContractError, match=named):
        encode_batch(replace(GOOD, **changed))


@pytest.mark.parametrize(("value", "named"), BAD_VALUES, ids=[f"value{i}" for i in range(len(BAD_VALUES))])
def test_an_invalid_value_is_refused(value, named):
    with pytest.raises(ContractError, match=named):
        encode_batch(replace(GOOD, columns={"speed": [None, value]}))
    with pytest.raises(ContractError, match=named):
        encode_live(replace(GOOD_LIVE, sample={"speed": value}))


def test_columns_too_large_for_the_decoder_are_not_encoded():
    n = 1_100
    batch = Batch(BOOT, 0, list(range(n)), {"text": ["x" * 4_000] * n})
    assert len(zlib.compress(b"x" * 4_000 * n)) < MAX_MESSAGE_BYTES, "it would fit in a message"
    with pytest.raises(ContractError, match="columns"):
        encode_batch(batch)
    for half in split_batch(batch):
        assert decode_batch(encode_batch(half)) == half


def test_dataclasses_are_frozen():
    for one in (GOOD, GOOD_LIVE):
        with pytest.raises(AttributeError):
            setattr(one, fields(one)[0].name, "x")
