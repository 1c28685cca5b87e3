"""The complexity guard: the largest allowed batch is read; a more expensive one is refused before parsing."""

from __future__ import annotations

import base64
import json
import zlib

import pytest

from iort_contract.codec import PLAIN_CODEC, check_effort
from iort_contract.limits import MAX_BATCH_VALUES, ContractError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch

BOOT = "0123abcd"
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
    columns = {"dt": [0] + [1] * 9_999, "fields": {"a.b": [0.5] * 10_000, "c": ["x", None] * 5_000}}
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


def enveloped(body, n):
    """A valid envelope with any body, in the codec that stores plain values."""
    good = json.loads(encode_batch(Batch(BOOT, 0, [0], {"a": [1]})))
    packed = base64.b64encode(zlib.compress(body)).decode()
    return {**good, "n": n, "codec": PLAIN_CODEC, "samples": packed}
