"""Batches that another program wrote: the error names the fault of the body or the envelope."""

from __future__ import annotations

import base64
import json
import re
import tracemalloc
import zlib
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.codec import PLAIN_CODEC
from iort_contract.limits import MAX_COLUMNS_BYTES, MAX_MESSAGE_BYTES, MAX_SAMPLES, ContractError
from iort_contract.messages.batch import decode_batch, encode_batch
from iort_contract.messages.live import decode_live, encode_live
from tests.examples import examples
from tests.unit.contract.contract_values import BOOT, DEEP, GOOD, GOOD_LIVE, decode_or_refuse, json_values


def enveloped(body, **changed):
    """A valid envelope of two samples with any body, in the codec that stores plain values;
    tests/unit/contract/codec/test_columns.py has the other."""
    packed = base64.b64encode(zlib.compress(body)).decode()
    return dict(json.loads(encode_batch(GOOD)), codec=PLAIN_CODEC, samples=packed, **changed)


@given(st.binary(max_size=100) | json_values.map(lambda value: json.dumps(value).encode()))
def test_any_body_is_decoded_or_refused(body):
    decode_or_refuse(decode_batch, enveloped(body))


@examples(300)
@given(st.data(), json_values)
def test_body_with_one_part_replaced(data, value):
    body = {"dt": [0, 5], "fields": {"a": [1, 2.5], "b": ["x", None]}}
    where = data.draw(st.sampled_from(["dt", "fields", "a", "b", "dt 0", "dt 1", "a 1", "name"]))
    if where in body:
        body[where] = value
    elif where == "name":
        body["fields"][data.draw(st.text(st.characters(), max_size=5))] = [1, 2]
    elif where in "ab":
        body["fields"][where] = value
    else:
        target = body["dt"] if where.startswith("dt") else body["fields"]["a"]
        target[int(where[-1])] = value
    decode_or_refuse(decode_batch, enveloped(json.dumps(body).encode()))


BODIES = [
    (b"", "not JSON"),
    (b"[]", "not a JSON object"),
    (b"{}", "2 dt"),
    (b"\xff\xfe{}", "not JSON"),
    (b'{"dt":[0,5],"fields":{"a":["\xff",1]}}', "not JSON"),
    (b"[" * DEEP, "nested"),
    (b'{"dt":' + b"[" * DEEP + b"]" * DEEP + b',"fields":{}}', "must be columns"),
    (b'{"dt":[0,5],"fields":' + b'{"a":' * DEEP + b"0" + b"}" * DEEP + b"}", "too many texts"),
    (b'{"dt":[0,5],"fields":{"a":[' + b"[" * 500 + b"]" * 500 + b",1]}}", "must hold numbers"),
    (b'{"dt":[0,5],"fields":{"a":[1,NaN]}}', "NaN"),
    (b'{"dt":[0,5],"fields":{"a":[1,-Infinity]}}', "Infinity"),
    (b'{"dt":[0,5],"fields":{"a":[1,1e999]}}', "field a: numbers must be finite"),
    (b'{"dt":[0,5],"fields":{"a":[1,18446744073709551616]}}', "field a: integers must fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,' + b"9" * 4300 + b"]}}", "field a: integers must fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,' + b"9" * 9000 + b"]}}", "not JSON|must fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,"\\ud800"]}}', "field a: texts must"),
    (b'{"dt":[0,5],"fields":{"a":["' + b"x" * 4097 + b'",1]}}', "field a: texts must"),
    (b'{"dt":[0,5],"fields":{"\\ud800":[1,1]}}', "field name"),
    (b'{"dt":[0,5],"fields":{"a":{"0":1,"1":2}}}', "field a must have 2 values"),
    (b'{"dt":[0,5],"fields":{"a":"ab"}}', "field a must have 2 values"),
    (b'{"dt":[0,5],"fields":{"a":[1]}}', "field a must have 2 values"),
    (b'{"dt":[0],"fields":{}}', "2 dt"),
    (b'{"dt":"05","fields":{}}', "2 dt"),
    (b'{"dt":[0,5],"fields":[]}', "object of fields"),
    (b'{"dt":[0,5.0],"fields":{}}', "dt must be integers"),
    (b'{"dt":[false,5],"fields":{}}', "dt must be integers"),
    (b'{"dt":[0,null],"fields":{}}', "dt must be integers"),
    (b'{"dt":[1,5],"fields":{}}', "first 0"),
    (b'{"dt":[0,-5],"fields":{}}', "in order"),
    (b'{"dt":[0,1000000],"fields":{}}', "span"),
    (b'{"dt":[0,1' + b"0" * 4299 + b'],"fields":{}}', "sample time"),
    (b'{"dt":[0,' + b"9" * 4300 + b'],"fields":{}}', "sample time"),
]


@pytest.mark.parametrize(("body", "named"), BODIES, ids=[f"body{i}" for i in range(len(BODIES))])
def test_an_invalid_body_is_refused(body, named):
    # The first time is 1, so that a step of 4,300 nines gives a number too long for Python to print.
    with pytest.raises(ContractError, match=named):
        decode_batch(enveloped(body, batch=f"{1:016}-{BOOT}-4"))


def test_too_many_fields_are_refused():
    body = json.dumps({"dt": [0, 5], "fields": {f"f{i}": [1, 2] for i in range(513)}})
    with pytest.raises(ContractError, match="fields, got 513"):
        decode_batch(enveloped(body.encode()))
    with pytest.raises(ContractError, match="sample"):
        decode_live(
            json.dumps(dict(json.loads(encode_live(GOOD_LIVE)), sample={f"f{i}": 1 for i in range(513)}))
        )


def test_the_last_of_duplicate_keys_counts():
    body = b'{"dt":[9],"fields":{"b":[1]},"dt":[0,5],"fields":{"a":[9,9],"a":[1,2]}}'
    assert decode_batch(enveloped(body)).columns == {"a": [1, 2]}


def test_a_body_up_to_the_size_limit_is_read():
    n = 8_388_608 // 4096
    times = {"dt": [0] + [1] * (n - 1)}
    room = MAX_COLUMNS_BYTES - len(json.dumps({**times, "fields": {"a": [""] * n}}))
    texts = ["x" * (room // n + (i < room % n)) for i in range(n)]
    body = json.dumps({**times, "fields": {"a": texts}}).encode()
    assert decode_batch(enveloped(body, n=n)).columns == {"a": texts}
    with pytest.raises(ContractError, match="at most 8388608 bytes"):
        decode_batch(enveloped(body + b" ", n=n))


def test_a_zip_bomb_is_not_inflated():
    message = json.dumps(enveloped(b" " * 64 * 1024 * 1024)).encode()
    assert len(message) < MAX_MESSAGE_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(ContractError, match="at most 8388608 bytes"):
            decode_batch(message)
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_COLUMNS_BYTES
    finally:
        tracemalloc.stop()


PACKED = zlib.compress(b'{"dt":[0,5],"fields":{}}')


@pytest.mark.parametrize(
    ("packed", "named"),
    [
        (b"", "truncated"),
        (PACKED[:-1], "truncated"),
        (PACKED + b"more", "trailing data"),
        (PACKED + PACKED, "trailing data"),
        (PACKED[:-4] + b"\0\0\0\0", "incorrect data check"),
        (b"\x1f\x8b" + PACKED, "must be base64 of zlib"),
        (b"not zlib", "must be base64 of zlib"),
    ],
    ids=["empty", "cut", "more", "twice", "checksum", "gzip", "text"],
)
def test_invalid_packed_samples_are_refused(packed, named):
    envelope = dict(enveloped(b""), samples=base64.b64encode(packed).decode())
    with pytest.raises(ContractError, match=named):
        decode_batch(envelope)


@pytest.mark.parametrize("text", ["é", "a", "====", "eJ\n", "eJ y", "-_-_", "\ud800", "eA==eA=="])
def test_samples_that_are_not_base64_are_refused(text):
    with pytest.raises(ContractError, match="samples"):
        decode_batch(dict(enveloped(b""), samples=text))


@pytest.mark.parametrize("samples", [None, 7, [], {}, True, Decimal(1)])
def test_samples_that_are_not_text_are_refused(samples):
    with pytest.raises(ContractError, match="samples must be base64 text"):
        decode_batch(dict(enveloped(b""), samples=samples))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"v": 1}, "schema version must be 2, got 1"),
        ({"v": 3}, "schema version must be 2, got 3"),
        ({"v": "1"}, "v must be an integer, got '1'"),
        ({"v": True}, "v must be an integer, got True"),
        ({"codec": "columns"}, "got 'columns'"),
        ({"n": 0}, "must say 1 to 50000 samples, got 0"),
        ({"n": 3}, "must have 3 dt"),
        ({"n": MAX_SAMPLES + 1}, "samples, got 50001"),
        ({"n": Decimal("1E+125")}, "n must be an integer, got Decimal"),
        ({"n": Decimal("NaN")}, "n must be an integer, got Decimal"),
        ({"n": Decimal("sNaN")}, "n must be an integer, got Decimal"),
        ({"n": 10**5000}, "n must be an integer, got <int>"),
        ({"batch": f"{2**53:016}-{BOOT}-4"}, "got 9007199254740992"),
        ({"batch": f"{0:016}-{BOOT}-{2**53 + 1}"}, "seq must be an integer from 0, got 9007199254740993"),
        ({"batch": f"{0:016}-{'0' * 33}-4"}, "got '0000000000000000-0000"),
        ({"nonfinite": b"0"}, "nonfinite must be an integer, got b'0'"),
        ({"nonfinite": None}, "nonfinite must be an integer, got None"),
    ],
)
def test_an_invalid_envelope_is_refused(changed, named):
    with pytest.raises(ContractError, match=re.escape(named)):
        decode_batch(dict(json.loads(encode_batch(GOOD)), **changed))
