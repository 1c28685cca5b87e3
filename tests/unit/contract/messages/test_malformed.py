"""Every decoder accepts a valid message and raises `ContractError` for any other input."""

from __future__ import annotations

import base64
import json
import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import ContractError
from iort_contract.messages.batch import decode_batch, encode_batch
from iort_contract.messages.live import decode_live, decode_pong, encode_live
from tests.examples import examples
from tests.unit.contract.contract_values import DEEP, GOOD, GOOD_LIVE, batches, decode_or_refuse, json_values

DECODERS = [decode_batch, decode_live, decode_pong]
decoders = st.sampled_from(DECODERS)


# Values of boto3 and Python that JSON does not have.
python_values = json_values | st.decimals() | st.binary(max_size=8) | st.sets(st.integers(), max_size=2)
awkward = st.sampled_from(
    [
        Decimal("NaN"),
        Decimal("sNaN"),
        Decimal("Infinity"),
        Decimal("1E+125"),
        Decimal("1E+999999999999"),
        Decimal("1E-130"),
        Decimal("1.0"),
        Decimal("-0"),
        10**5000,
        2**53,
        2**63,
        1e308,
        math.nan,
        math.inf,
        -0.0,
        "",
        "1",
        b"1",
        bytearray(b"1"),
        (),
        "\ud800",
        object(),
    ]
)


def envelopes():
    return st.sampled_from([encode_batch(GOOD), encode_live(GOOD_LIVE)]).map(json.loads)


@given(decoders, st.binary(max_size=200))
def test_any_bytes_are_decoded_or_refused(decoder, message):
    decode_or_refuse(decoder, message)


@given(decoders, st.text(st.characters(), max_size=200))
def test_any_text_is_decoded_or_refused(decoder, message):
    decode_or_refuse(decoder, message)


@given(decoders, json_values)
def test_any_json_is_decoded_or_refused(decoder, value):
    decode_or_refuse(decoder, json.dumps(value))
    decode_or_refuse(decoder, json.dumps(value).encode("utf-16"))


@given(st.sampled_from(DECODERS[:2]), st.dictionaries(st.text(max_size=4), python_values, max_size=4))
def test_any_table_item_is_decoded_or_refused(decoder, item):
    decode_or_refuse(decoder, item)


@examples(300)
@given(st.data(), python_values | awkward)
def test_a_message_with_one_key_replaced_is_decoded_or_refused(data, value):
    envelope = data.draw(envelopes())
    envelope[data.draw(st.sampled_from(sorted(envelope)))] = value
    for decoder in DECODERS[:2]:
        decode_or_refuse(decoder, envelope)


@examples(200)
@given(st.data(), json_values)
def test_a_text_with_one_key_replaced_is_decoded_or_refused(data, value):
    envelope = data.draw(envelopes())
    envelope[data.draw(st.sampled_from(sorted(envelope)))] = value
    for decoder in DECODERS:
        decode_or_refuse(decoder, json.dumps(envelope))


@pytest.mark.parametrize("good", [encode_batch(GOOD), encode_live(GOOD_LIVE)], ids=["batch", "live"])
def test_a_message_with_one_key_removed_is_decoded_or_refused(good):
    decoder = decode_batch if b"codec" in good else decode_live
    for key in json.loads(good):
        envelope = json.loads(good)
        del envelope[key]
        with pytest.raises(ContractError, match=key):
            decoder(json.dumps(envelope))


@examples(300)
@given(batches(), st.data())
def test_a_damaged_message_is_decoded_or_refused(batch, data):
    message = bytearray(encode_batch(batch))
    at = data.draw(st.integers(0, len(message) - 1))
    message[at] = data.draw(st.integers(0, 255))
    decode_or_refuse(decode_batch, bytes(message))
    decode_or_refuse(decode_batch, bytes(message[:at]))


@examples(200)
@given(st.data())
def test_damaged_compressed_samples_are_decoded_or_refused(data):
    envelope = json.loads(encode_batch(GOOD))
    packed = bytearray(base64.b64decode(envelope["samples"]))
    at = data.draw(st.integers(0, len(packed) - 1))
    packed[at] ^= data.draw(st.integers(1, 255))
    decode_or_refuse(decode_batch, dict(envelope, samples=base64.b64encode(packed).decode()))


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"null",
        b"\xef\xbb\xbf{}",
        b"\xed\xa0\x80",
        b'{"v":' + b"[" * DEEP,
        b'{"v":' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"v":1e999}',
        b'{"v":NaN}',
        b'{"v":1,"seq":' + b"9" * 5000 + b"}",
        "\ud800",
        '{"v":"\ud800"}',
        None,
        7,
        [],
    ],
)
def test_an_invalid_message_is_refused(decoder, message):
    with pytest.raises(ContractError):
        decoder(message)


def test_the_error_for_a_long_value_is_short():
    with pytest.raises(ContractError) as caught:
        decode_batch(dict(json.loads(encode_batch(GOOD)), codec="x" * 10_000))
    assert len(str(caught.value)) < 200


def test_the_contracts_error_is_a_value_error():
    assert issubclass(ContractError, ValueError)
