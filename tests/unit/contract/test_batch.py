"""Batches are decoded bit for bit as they were encoded; the encoder refuses invalid batches."""

from __future__ import annotations

import base64
import json
import math
import re
import tracemalloc
import zlib
from dataclasses import replace
from decimal import Decimal

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from iort_contract.codec import DICTIONARY, inflate
from iort_contract.limits import (
    MAX_BATCH_SPAN_US,
    MAX_COLUMNS_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_SAMPLES,
    ContractError,
)
from iort_contract.messages.batch import (
    Batch,
    BatchId,
    batch_id,
    batches_between,
    decode_batch,
    encode_batch,
    split_batch,
)
from iort_contract.messages.live import decode_live, encode_live
from tests.examples import examples
from tests.unit.contract.contract_values import (
    BAD_HEADERS,
    BOOT,
    DEEP,
    GOOD,
    GOOD_LIVE,
    LIMIT_US,
    MOST_NONFINITE,
    anything,
    batches,
    boots,
    decode_or_refuse,
    json_values,
    nulled,
    same,
    seqs,
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
    assert encode_batch(decode_batch(message)) == message


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
    (Decimal(1), "must hold numbers"),
]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        *BAD_HEADERS,
        ({"times_us": []}, "samples, got 0"),
        ({"times_us": range(MAX_SAMPLES + 1)}, "samples, got 50001"),
        ({"times_us": [5, 0]}, "in order"),
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


# Batches that another program wrote: the error names the fault of the body or the envelope.


def enveloped(body, **changed):
    """A valid envelope of two samples with any body."""
    deflater = zlib.compressobj(zdict=DICTIONARY)
    samples = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    return dict(json.loads(encode_batch(GOOD)), samples=samples, **changed)


@examples(300)
@given(st.data(), json_values)
def test_body_with_one_part_replaced(data, value):
    body = {"dt": [0, 5], "fields": {"a": [None, 1, 2.5], "b": [None, "x", None]}}
    where = data.draw(st.sampled_from(["dt", "fields", "a", "b", "dt 0", "dt 1", "a 1", "name"]))
    if where in body:
        body[where] = value
    elif where == "name":
        body["fields"][data.draw(st.text(st.characters(), max_size=5))] = [0, 1, 2]
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
    (b'{"dt":[0,5],"fields":{"a":[null,"\xff",1]}}', "not JSON"),
    (b"[" * DEEP, "nested"),
    (b'{"dt":' + b"[" * DEEP + b"]" * DEEP + b',"fields":{}}', "must be columns"),
    (b'{"dt":[0,5],"fields":' + b'{"a":' * DEEP + b"0" + b"}" * DEEP + b"}", "too many texts"),
    (b'{"dt":[0,5],"fields":{"a":[null,' + b"[" * 150 + b"]" * 150 + b",1]}}", "must hold numbers"),
    (b'{"dt":[0,5],"fields":{"a":[null,1,NaN]}}', "NaN"),
    (b'{"dt":[0,5],"fields":{"a":[null,1,1e999]}}', "field a: numbers must be finite"),
    (b'{"dt":[0,5],"fields":{"a":[null,1,18446744073709551616]}}', "field a: integers must fit"),
    (b'{"dt":[0,5],"fields":{"a":[null,1,' + b"9" * 9000 + b"]}}", "not JSON|must fit"),
    (b'{"dt":[0,5],"fields":{"a":[null,1,"\\ud800"]}}', "field a: texts must"),
    (b'{"dt":[0,5],"fields":{"a":[null,"' + b"x" * 4097 + b'",1]}}', "field a: texts must"),
    (b'{"dt":[0,5],"fields":{"\\ud800":[null,1,1]}}', "field name"),
    (b'{"dt":[0,5],"fields":{"a":{"0":1,"1":2}}}', "field a must have 2 values"),
    (b'{"dt":[0,5],"fields":{"a":"ab"}}', "field a must have 2 values"),
    (b'{"dt":[0],"fields":{}}', "2 dt"),
    (b'{"dt":[0,5],"fields":[]}', "object of fields"),
    (b'{"dt":[0,5.0],"fields":{}}', "dt must be integers"),
    (b'{"dt":[false,5],"fields":{}}', "dt must be integers"),
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
    body = b'{"dt":[9],"fields":{"b":[0,1]},"dt":[0,5],"fields":{"a":[0,9,9],"a":[0,1,1]}}'
    assert decode_batch(enveloped(body)).columns == {"a": [1, 2]}


def test_a_body_up_to_the_size_limit_is_read():
    n, most = 1024, MAX_COLUMNS_BYTES // 2
    times = {"dt": [0] + [1] * (n - 1)}
    room = most - len(json.dumps({**times, "fields": {"a": [None, *[""] * n]}}))
    texts = ["x" * (room // n + (i < room % n)) for i in range(n)]
    body = json.dumps({**times, "fields": {"a": [None, *texts]}}).encode()
    assert decode_batch(enveloped(body, n=n)).columns == {"a": texts}
    with pytest.raises(ContractError, match=f"at most {most} bytes"):
        decode_batch(enveloped(body + b" ", n=n))


def test_a_zip_bomb_is_not_inflated():
    message = json.dumps(enveloped(b" " * 64 * 1024 * 1024)).encode()
    assert len(message) < MAX_MESSAGE_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(ContractError, match="at most 4194304 bytes"):
            decode_batch(message)
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_COLUMNS_BYTES
    finally:
        tracemalloc.stop()


PACKED = base64.b64decode(enveloped(b'{"dt":[0,5],"fields":{}}')["samples"])


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


@pytest.mark.parametrize(
    "text", ["é", "a", "====", "eJ\n", "eJ y", "-_-_", "\ud800", "eA==eA==", None, 7, [], {}, True]
)
def test_samples_that_are_not_base64_are_refused(text):
    with pytest.raises(ContractError, match="samples"):
        decode_batch(dict(enveloped(b""), samples=text))


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
        ({"n": 10**5000}, "n must be an integer, got <int>"),
        ({"batch": f"{2**53:016}-{BOOT}-4"}, "got 9007199254740992"),
        (
            {"batch": f"{0:016}-{BOOT}-{2**53 + 1}"},
            "seq must be an integer from 0 to 9007199254740992, got 9007199254740993",
        ),
        ({"batch": f"{0:016}-{'0' * 33}-4"}, "got '0000000000000000-0000"),
        ({"nonfinite": b"0"}, "nonfinite must be an integer, got b'0'"),
        ({"nonfinite": None}, "nonfinite must be an integer, got None"),
    ],
)
def test_an_invalid_envelope_is_refused(changed, named):
    with pytest.raises(ContractError, match=re.escape(named)):
        decode_batch(dict(json.loads(encode_batch(GOOD)), **changed))


# Batch ids are unique within a topic, and as text they sort by time.

times = st.integers(0, LIMIT_US)
ids = st.builds(BatchId, times, boots, seqs)


@given(ids)
def test_an_id_is_parsed_as_it_was_written(one):
    assert batch_id(str(one)) == one


@given(ids, ids)
def test_an_earlier_batch_has_a_smaller_key(one, other):
    if one.t_us != other.t_us:
        assert (str(one) < str(other)) == (one.t_us < other.t_us)
    assert (str(one) == str(other)) == (one == other)


@given(ids, st.none() | times | st.integers(), st.none() | times | st.integers())
def test_a_range_of_times_is_a_range_of_keys(one, first_us, last_us):
    first, last = batches_between(first_us, last_us)
    inside = (first_us is None or first_us <= one.t_us) and (last_us is None or one.t_us <= last_us)
    assert (first <= str(one) <= last) == inside


@pytest.mark.parametrize("at", [0, 1, LIMIT_US])
def test_both_ends_of_a_range_belong_to_it(at):
    first, last = batches_between(at, at)
    greatest = BatchId(at, "f" * 32, 2**53)
    assert first <= str(BatchId(at, "0" * 8, 0)) < str(greatest) <= last
    assert not first <= str(BatchId(at + 1, "0" * 8, 0)) <= last
    if at:
        assert not first <= str(BatchId(at - 1, "f" * 32, 2**53)) <= last


@pytest.mark.parametrize(
    "text",
    [
        None,
        5,
        Decimal(5),
        b"0000000000000005-0123abcd-7",
        "",
        f"5-{BOOT}-7",
        f"000000000000005-{BOOT}-7",
        f"00000000000000005-{BOOT}-7",
        f"-000000000000005-{BOOT}-7",
        f"000000000000000٣-{BOOT}-7",
        f"0000000000000005-{BOOT.upper()}-7",
        "0000000000000005-0123abc-7",
        f"0000000000000005-{'0' * 33}-7",
        f"0000000000000005-{BOOT}-07",
        f"0000000000000005-{BOOT}",
        f"0000000000000005-{BOOT}-{10**16}",
        f"0000000000000005-{BOOT}-7\n",
        "x" * 100_000,
    ],
)
def test_an_invalid_id_is_refused(text):
    with pytest.raises(ContractError, match="must be <16 digits of microseconds>-<run>-<number>"):
        batch_id(text)
