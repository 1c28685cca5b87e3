"""The contract, by property: what it writes it reads, and what is malformed raises its error alone."""

from __future__ import annotations

import base64
import json
import math
import re
import struct
import tracemalloc
import zlib
from dataclasses import fields, replace
from decimal import Decimal

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import contract
from contract import Batch, ContractError, LiveSample

LIMIT_US = 2**53 - 1
BOOT = "0123abcd"

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}(\.[A-Za-z0-9_]{1,4}){0,2}", fullmatch=True)
robots = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
namespaces = st.from_regex(r"[a-z][a-z0-9]{0,15}", fullmatch=True)
boots = st.from_regex(r"[0-9a-f]{8,32}", fullmatch=True)
seqs = st.integers(0, 2**53)
times = st.integers(-LIMIT_US, LIMIT_US)
EDGES = [-0.0, 5e-324, -2.2e-308, 1e308, 2.0**53 - 1, 2.0**53, -(2.0**53), 1e15 + 0.5, 3.0, 1e-7]
finite = st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(EDGES)
integers = st.integers(-(2**63), 2**64 - 1) | st.sampled_from([-(2**63), 2**63, 2**64 - 1, 2**53 + 1])
# st.text leaves out the surrogates, which no Unicode text holds.
values = st.none() | st.booleans() | integers | finite | st.text(max_size=20)


@st.composite
def batches(draw, kinds=values):
    offsets = draw(st.sets(st.integers(1, contract.MAX_BATCH_SPAN_US - 1), max_size=12))
    first = draw(st.integers(-LIMIT_US, LIMIT_US - contract.MAX_BATCH_SPAN_US) | st.just(0))
    n = 1 + len(offsets)
    # Columns as recordings have them, of one kind, and of any mixture.
    column = st.one_of(
        st.lists(kinds, min_size=n, max_size=n),
        st.lists(finite, min_size=n, max_size=n),
        st.lists(integers, min_size=n, max_size=n),
    )
    columns = draw(st.dictionaries(names, column, max_size=5))
    steps = [first] + [first + offset for offset in sorted(offsets)]
    return Batch(draw(boots), draw(seqs), steps, columns, draw(st.integers(0, 1000)))


samples = st.dictionaries(names, values, max_size=8)
lives = st.builds(LiveSample, boots, seqs, times, times, samples, st.integers(0, 1000), st.none() | times)


def same(one, other):
    """Equal, and of the same kind: True is not 1; only a whole float becomes the integer it equals."""
    if type(one) is float and type(other) is int:
        return one == other
    return type(one) is type(other) and one == other


def strict(text):
    """JSON as any other language reads it: without NaN and Infinity."""

    def refuse(name):
        raise AssertionError(f"{name} in {text[:100]!r}")

    return json.loads(text, parse_constant=refuse)


def body_of(envelope):
    return contract.inflate(envelope["samples"], envelope["codec"])


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


# --- what is written is read ------------------------------------------------------------------------


@given(batches())
def test_batch_round_trip(batch):
    message = contract.encode(batch)
    assert_same_batch(contract.decode(message), batch)
    assert_same_batch(contract.decode(message.decode()), batch)
    assert_same_batch(contract.decode(json.loads(message)), batch)
    assert_same_batch(contract.decode(stored(message)), batch)
    assert batch.t_us == batch.times_us[0]


@given(batches())
def test_encoding_again_gives_the_same_message(batch):
    message = contract.encode(batch)
    assert contract.encode(contract.decode(message)) == message


@given(lives)
def test_live_round_trip(live):
    message = contract.encode_live(live)
    for decoded in map(contract.decode_live, (message, message.decode(), handed_over(message))):
        assert replace(decoded, sample={}) == replace(live, sample={})
        assert list(decoded.sample) == list(live.sample)
        assert all(same(live.sample[name], decoded.sample[name]) for name in live.sample)


def handed_over(message):
    """As the live rule gives it to Lambda 1, and Lambda 1 takes it."""
    event = contract.live_event(message, "live/iort/car/vesc", 1_700_000_000_000)
    return contract.live_message(json.loads(json.dumps(event)))


@pytest.mark.parametrize("event", [{}, {contract.MESSAGE_BASE64: 7}, {contract.MESSAGE_BASE64: "a%"}])
def test_an_event_of_another_kind_holds_no_live_message(event):
    with pytest.raises(ContractError, match=contract.MESSAGE_BASE64):
        contract.live_message(event)


@pytest.mark.parametrize("n", [1, 2, 50, 1000])
def test_batch_of_a_drive(n):
    columns = {name: [i / 7 for i in range(n)] for name in contract.VESC_FIELDS}
    batch = Batch(BOOT, 7, [i * 999 for i in range(n)], columns)
    assert contract.decode(contract.encode(batch)) == batch


def test_whole_floats_become_integers_on_the_wire():
    batch = Batch(BOOT, 0, [0], {"a": [3.0], "b": [-0.0], "c": [1e300], "d": [True], "e": [0.5]})
    message = contract.encode(batch)
    assert body_of(json.loads(message)) == (
        b'{"dt":[0],"fields":{"a":[0,3],"b":[0,0],"c":[null,1e+300],"d":[null,true],"e":[1,5]}}'
    )
    assert list(map(type, (c[0] for c in contract.decode(message).columns.values()))) == [
        int, int, float, bool, float,
    ]  # fmt: skip


def test_the_envelope_names_what_it_holds():
    batch = Batch(BOOT, 3, [1_000, 1_250, 1_900], {"speed": [1, 2.5, None]})
    envelope = json.loads(contract.encode(batch))
    assert {key: envelope[key] for key in envelope if key != "samples"} == {
        "v": 1,
        "boot": BOOT,
        "seq": 3,
        "t": 1_000,
        "n": 3,
        "nonfinite": 0,
        "codec": "steps",
    }
    assert json.loads(body_of(envelope)) == {"dt": [0, 250, 650], "fields": {"speed": [None, 1, 2.5, None]}}


def nulled(value):
    return None if type(value) is float and not math.isfinite(value) else value


anything = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf]) | values


@given(batches(kinds=anything))
def test_nonfinite_becomes_null_and_is_counted(batch):
    message = contract.encode(batch)
    strict(body_of(strict(message)))
    expected = {name: list(map(nulled, column)) for name, column in batch.columns.items()}
    new = sum(
        value is None and was is not None
        for name, column in batch.columns.items()
        for value, was in map(lambda *pair: pair, expected[name], column)
    )
    clean = replace(batch, columns=expected, nonfinite=batch.nonfinite + new)
    assert_same_batch(contract.decode(message), clean)


@given(st.dictionaries(names, anything, max_size=8))
@example({"a": math.nan, "b": math.inf, "c": -math.inf})
def test_live_nonfinite_becomes_null_and_is_counted(sample):
    message = contract.encode_live(LiveSample(BOOT, 0, 0, 0, sample, 5))
    strict(message)
    decoded = contract.decode_live(message)
    assert decoded.sample == {name: nulled(value) for name, value in sample.items()}
    assert decoded.nonfinite == 5 + sum(nulled(v) is None and v is not None for v in sample.values())


def test_bits_of_a_float_survive():
    numbers = [struct.unpack("<d", struct.pack("<Q", bits))[0] for bits in (1, 2**52 - 1, 0x7FEFFFFFFFFFFFFF)]
    batch = Batch(BOOT, 0, [0, 1, 2], {"x": numbers})
    assert contract.decode(contract.encode(batch)).columns["x"] == numbers


@given(batches())
def test_halves_make_up_the_whole(batch):
    assume(len(batch.times_us) > 1)
    first, second = contract.split(batch)
    assert (first.seq, second.seq) == (batch.seq, batch.seq + 1)
    assert first.boot == second.boot == batch.boot
    assert first.nonfinite + second.nonfinite == batch.nonfinite
    assert abs(len(first.times_us) - len(second.times_us)) <= 1
    assert [*first.times_us, *second.times_us] == batch.times_us
    assert list(first.columns) == list(second.columns) == list(batch.columns)
    for name, column in batch.columns.items():
        assert [*first.columns[name], *second.columns[name]] == column
    assert_same_batch(contract.decode(contract.encode(first)), first)


def test_one_sample_does_not_split():
    with pytest.raises(ContractError, match="one sample of 1 fields"):
        contract.split(Batch(BOOT, 0, [0], {"a": [1]}))


# --- what is not allowed is not written --------------------------------------------------------------

GOOD = Batch(BOOT, 4, [0, 5], {"speed": [1.5, 2.5]}, 0)
GOOD_LIVE = LiveSample(BOOT, 4, 0, 5, {"speed": 1.5}, 0)
MOST_NONFINITE = contract.MAX_SAMPLES * contract.MAX_FIELDS

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
BAD_VALUES = [
    (2**64, "64 bits"),
    (-(2**63) - 1, "64 bits"),
    (10**5000, "64 bits"),
    ("\ud800", "not Unicode"),
    ("ok \udfff", "not Unicode"),
    ("x" * 4097, "4096"),
    (b"bytes", "neither number"),
    ([1], "neither number"),
    ({"a": 1}, "neither number"),
    (Decimal(1), "neither number"),
    (1j, "neither number"),
]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        *BAD_HEADERS,
        ({"times_us": []}, "0 samples"),
        ({"times_us": range(contract.MAX_SAMPLES + 1)}, "50001 samples"),
        ({"times_us": [0, 0]}, "strictly increase"),
        ({"times_us": [5, 0]}, "strictly increase"),
        ({"times_us": [0, contract.MAX_BATCH_SPAN_US]}, "span"),
        ({"times_us": [2**53, 2**53 + 1]}, "sample time"),
        ({"times_us": [0, 1.0]}, "sample time"),
        ({"times_us": [False, True]}, "sample time"),
        ({"times_us": ["0", "1"]}, "sample time"),
        ({"columns": {"speed": [1]}}, "field speed: 1 values for 2"),
        ({"columns": {f"f{i}": [0, 0] for i in range(513)}}, "513 fields"),
        ({"columns": {"speed": [math.nan, 0]}, "nonfinite": MOST_NONFINITE}, "nonfinite"),
        ({"columns": {"": [1, 2]}}, "field name"),
        ({"columns": {"a..b": [1, 2]}}, "field name"),
        ({"columns": {"a\n": [1, 2]}}, "field name"),
        ({"columns": {"1a": [1, 2]}}, "field name"),
        ({"columns": {"größe": [1, 2]}}, "field name"),
        ({"columns": {"a٣": [1, 2]}}, "field name"),
        ({"columns": {7: [1, 2]}}, "field name 7"),
    ],
)
def test_batch_refused(changed, named):
    with pytest.raises(ContractError, match=named):
        contract.encode(replace(GOOD, **changed))


@pytest.mark.parametrize(("value", "named"), BAD_VALUES, ids=[f"value{i}" for i in range(len(BAD_VALUES))])
def test_value_refused(value, named):
    with pytest.raises(ContractError, match=named):
        contract.encode(replace(GOOD, columns={"speed": [None, value]}))
    with pytest.raises(ContractError, match=named):
        contract.encode_live(replace(GOOD_LIVE, sample={"speed": value}))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        *BAD_HEADERS,
        ({"t_us": 2**53}, "sample time"),
        ({"t_us": 1.5}, "sample time"),
        ({"sent_us": True}, "sent_us"),
        ({"offset_us": 0.5}, "offset_us"),
        ({"offset_us": 2**53}, "offset_us"),
        ({"sample": {f"f{i}": 0 for i in range(513)}}, "513 fields"),
        ({"sample": {"a b": 1}}, "field name"),
        ({"sample": {"speed": math.nan}, "nonfinite": MOST_NONFINITE}, "nonfinite"),
    ],
)
def test_live_refused(changed, named):
    with pytest.raises(ContractError, match=named):
        contract.encode_live(replace(GOOD_LIVE, **changed))


def test_columns_too_large_to_be_read_are_not_written():
    n = 1_100
    batch = Batch(BOOT, 0, list(range(n)), {"text": ["x" * 4_000] * n})
    assert len(zlib.compress(b"x" * 4_000 * n)) < contract.MAX_MESSAGE_BYTES, "it would fit in a message"
    with pytest.raises(ContractError, match="columns"):
        contract.encode(batch)
    for half in contract.split(batch):
        assert contract.decode(contract.encode(half)) == half


# --- what is malformed raises the contract's error and nothing else ----------------------------------

DECODERS = [contract.decode, contract.decode_live, contract.decode_pong]
decoders = st.sampled_from(DECODERS)


def decode_or_refuse(decoder, message):
    """Anything but `ContractError` fails; what is taken must be such as could have been written."""
    try:
        taken = decoder(message)
    except ContractError as error:
        str(error).encode()  # it can be logged, whatever was in the message
        return
    if isinstance(taken, Batch):
        assert contract.decode(contract.encode(taken)) == taken
    elif isinstance(taken, LiveSample):
        assert contract.decode_live(contract.encode_live(taken)) == taken


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=10),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)
# What boto3 and Python can put into a mapping that JSON cannot.
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
    return st.sampled_from([contract.encode(GOOD), contract.encode_live(GOOD_LIVE)]).map(json.loads)


@given(decoders, st.binary(max_size=200))
def test_any_bytes(decoder, message):
    decode_or_refuse(decoder, message)


@given(decoders, st.text(st.characters(), max_size=200))
def test_any_text(decoder, message):
    decode_or_refuse(decoder, message)


@given(decoders, json_values)
def test_any_json(decoder, value):
    decode_or_refuse(decoder, json.dumps(value))
    decode_or_refuse(decoder, json.dumps(value).encode("utf-16"))


@given(st.sampled_from(DECODERS[:2]), st.dictionaries(st.text(max_size=4), python_values, max_size=4))
def test_any_item(decoder, item):
    decode_or_refuse(decoder, item)


@settings(max_examples=300)
@given(st.data(), python_values | awkward)
def test_one_key_replaced(data, value):
    envelope = data.draw(envelopes())
    envelope[data.draw(st.sampled_from(sorted(envelope)))] = value
    for decoder in DECODERS[:2]:
        decode_or_refuse(decoder, envelope)


@settings(max_examples=200)
@given(st.data(), json_values)
def test_one_key_replaced_in_text(data, value):
    envelope = data.draw(envelopes())
    envelope[data.draw(st.sampled_from(sorted(envelope)))] = value
    for decoder in DECODERS:
        decode_or_refuse(decoder, json.dumps(envelope))


@pytest.mark.parametrize(
    "good", [contract.encode(GOOD), contract.encode_live(GOOD_LIVE)], ids=["batch", "live"]
)
def test_one_key_removed(good):
    decoder = contract.decode if b"codec" in good else contract.decode_live
    for key in json.loads(good):
        envelope = json.loads(good)
        del envelope[key]
        with pytest.raises(ContractError, match=key):
            decoder(json.dumps(envelope))


def enveloped(body, **changed):
    """A good envelope of two samples around any body, in the codec whose columns are their values alone;
    tests/unit/test_columns.py has the other."""
    packed = base64.b64encode(zlib.compress(body)).decode()
    return dict(json.loads(contract.encode(GOOD)), codec=contract.PLAIN_CODEC, samples=packed, **changed)


@given(st.binary(max_size=100) | json_values.map(lambda value: json.dumps(value).encode()))
def test_any_body(body):
    decode_or_refuse(contract.decode, enveloped(body))


@settings(max_examples=300)
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
    decode_or_refuse(contract.decode, enveloped(json.dumps(body).encode()))


@settings(max_examples=300)
@given(batches(), st.data())
def test_message_damaged_anywhere(batch, data):
    message = bytearray(contract.encode(batch))
    at = data.draw(st.integers(0, len(message) - 1))
    message[at] = data.draw(st.integers(0, 255))
    decode_or_refuse(contract.decode, bytes(message))
    decode_or_refuse(contract.decode, bytes(message[:at]))


@settings(max_examples=200)
@given(st.data())
def test_compressed_samples_damaged(data):
    envelope = json.loads(contract.encode(GOOD))
    packed = bytearray(base64.b64decode(envelope["samples"]))
    at = data.draw(st.integers(0, len(packed) - 1))
    packed[at] ^= data.draw(st.integers(1, 255))
    decode_or_refuse(contract.decode, dict(envelope, samples=base64.b64encode(packed).decode()))


DEEP = 100_000
BODIES = [
    (b"", "not JSON"),
    (b"[]", "not a JSON object"),
    (b"{}", "2 dt"),
    (b"\xff\xfe{}", "not JSON"),
    (b'{"dt":[0,5],"fields":{"a":["\xff",1]}}', "not JSON"),
    (b"[" * DEEP, "nested"),
    (b'{"dt":' + b"[" * DEEP + b"]" * DEEP + b',"fields":{}}', "nested"),
    (b'{"dt":[0,5],"fields":' + b'{"a":' * DEEP + b"0" + b"}" * DEEP + b"}", "nested"),
    (b'{"dt":[0,5],"fields":{"a":[' + b"[" * 500 + b"]" * 500 + b",1]}}", "neither number"),
    (b'{"dt":[0,5],"fields":{"a":[1,NaN]}}', "NaN"),
    (b'{"dt":[0,5],"fields":{"a":[1,-Infinity]}}', "Infinity"),
    (b'{"dt":[0,5],"fields":{"a":[1,1e999]}}', "field a: a number is not finite"),
    (b'{"dt":[0,5],"fields":{"a":[1,18446744073709551616]}}', "field a: an integer does not fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,' + b"9" * 4300 + b"]}}", "field a: an integer does not fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,' + b"9" * 9000 + b"]}}", "not JSON|does not fit"),
    (b'{"dt":[0,5],"fields":{"a":[1,"\\ud800"]}}', "field a: a text"),
    (b'{"dt":[0,5],"fields":{"a":["' + b"x" * 4097 + b'",1]}}', "field a: a text"),
    (b'{"dt":[0,5],"fields":{"\\ud800":[1,1]}}', "field name"),
    (b'{"dt":[0,5],"fields":{"a":{"0":1,"1":2}}}', "field a: expected 2 values"),
    (b'{"dt":[0,5],"fields":{"a":"ab"}}', "field a: expected 2 values"),
    (b'{"dt":[0,5],"fields":{"a":[1]}}', "field a: expected 2 values"),
    (b'{"dt":[0],"fields":{}}', "2 dt"),
    (b'{"dt":"05","fields":{}}', "2 dt"),
    (b'{"dt":[0,5],"fields":[]}', "object of fields"),
    (b'{"dt":[0,5.0],"fields":{}}', "dt must be integers"),
    (b'{"dt":[false,5],"fields":{}}', "dt must be integers"),
    (b'{"dt":[0,null],"fields":{}}', "dt must be integers"),
    (b'{"dt":[1,5],"fields":{}}', "first 0"),
    (b'{"dt":[0,0],"fields":{}}', "strictly increase"),
    (b'{"dt":[0,-5],"fields":{}}', "strictly increase"),
    (b'{"dt":[0,1000000],"fields":{}}', "span"),
    (b'{"dt":[0,1' + b"0" * 4299 + b'],"fields":{}}', "sample time"),
    (b'{"dt":[0,' + b"9" * 4300 + b'],"fields":{}}', "sample time"),
]


@pytest.mark.parametrize(("body", "named"), BODIES, ids=[f"body{i}" for i in range(len(BODIES))])
def test_body_refused(body, named):
    # Of time 1, so that a step of 4,300 nines makes a number too long for Python to print.
    with pytest.raises(ContractError, match=named):
        contract.decode(enveloped(body, t=1))


def test_too_many_fields_are_refused():
    body = json.dumps({"dt": [0, 5], "fields": {f"f{i}": [1, 2] for i in range(513)}})
    with pytest.raises(ContractError, match="513 fields"):
        contract.decode(enveloped(body.encode()))
    with pytest.raises(ContractError, match="sample"):
        contract.decode_live(
            json.dumps(
                dict(json.loads(contract.encode_live(GOOD_LIVE)), sample={f"f{i}": 1 for i in range(513)})
            )
        )


def test_the_last_of_duplicate_keys_counts():
    body = b'{"dt":[9],"fields":{"b":[1]},"dt":[0,5],"fields":{"a":[9,9],"a":[1,2]}}'
    assert contract.decode(enveloped(body)).columns == {"a": [1, 2]}


def test_body_of_the_greatest_size_is_read_and_no_larger():
    body = b'{"dt":[0,5],"fields":{}}'
    room = contract.MAX_COLUMNS_BYTES - len(body)
    assert contract.decode(enveloped(body + b" " * room)).columns == {}
    with pytest.raises(ContractError, match="over 8388608 bytes"):
        contract.decode(enveloped(body + b" " * (room + 1)))


def test_zip_bomb_is_not_inflated():
    message = json.dumps(enveloped(b" " * 64 * 1024 * 1024)).encode()
    assert len(message) < contract.MAX_MESSAGE_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(ContractError, match="over 8388608 bytes"):
            contract.decode(message)
        assert tracemalloc.get_traced_memory()[1] < 3 * contract.MAX_COLUMNS_BYTES
    finally:
        tracemalloc.stop()


PACKED = zlib.compress(b'{"dt":[0,5],"fields":{}}')


@pytest.mark.parametrize(
    ("packed", "named"),
    [
        (b"", "cut short"),
        (PACKED[:-1], "cut short"),
        (PACKED + b"more", "more follows"),
        (PACKED + PACKED, "more follows"),
        (PACKED[:-4] + b"\0\0\0\0", "incorrect data check"),
        (b"\x1f\x8b" + PACKED, "not base64 of zlib"),
        (b"not zlib", "not base64 of zlib"),
    ],
    ids=["empty", "cut", "more", "twice", "checksum", "gzip", "text"],
)
def test_packed_samples_refused(packed, named):
    envelope = dict(enveloped(b""), samples=base64.b64encode(packed).decode())
    with pytest.raises(ContractError, match=named):
        contract.decode(envelope)


@pytest.mark.parametrize("text", ["é", "a", "====", "eJ\n", "eJ y", "-_-_", "\ud800", "eA==eA=="])
def test_samples_that_are_not_base64_are_refused(text):
    with pytest.raises(ContractError, match="samples"):
        contract.decode(dict(enveloped(b""), samples=text))


@pytest.mark.parametrize("samples", [None, 7, [], {}, True, Decimal(1)])
def test_samples_that_are_not_text_are_refused(samples):
    with pytest.raises(ContractError, match="expected base64 text"):
        contract.decode(dict(enveloped(b""), samples=samples))


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"v": 2}, "schema version 2"),
        ({"v": "1"}, "v '1'"),
        ({"v": True}, "v True"),
        ({"codec": "columns"}, "codec 'columns'"),
        ({"n": 0}, "0 samples"),
        ({"n": 3}, "expected 3 dt"),
        ({"n": contract.MAX_SAMPLES + 1}, "50001 samples"),
        ({"n": Decimal("1E+125")}, "n Decimal"),
        ({"seq": 1.5}, "seq 1.5"),
        ({"seq": Decimal("NaN")}, "seq Decimal"),
        ({"seq": Decimal("sNaN")}, "seq Decimal"),
        ({"seq": 10**5000}, "seq <int>"),
        ({"t": Decimal("1E+999999999999")}, "t Decimal"),
        ({"t": 2**53}, "sample time"),
        ({"t": Decimal("0.5")}, "t Decimal"),
        ({"nonfinite": b"0"}, "nonfinite b'0'"),
    ],
)
def test_envelope_refused(changed, named):
    with pytest.raises(ContractError, match=re.escape(named)):
        contract.decode(dict(json.loads(contract.encode(GOOD)), **changed))


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
def test_message_refused(decoder, message):
    with pytest.raises(ContractError):
        decoder(message)


def test_error_of_a_long_value_is_short():
    with pytest.raises(ContractError) as caught:
        contract.decode(dict(json.loads(contract.encode(GOOD)), codec="x" * 10_000))
    assert len(str(caught.value)) < 200


def test_there_is_one_error():
    assert issubclass(ContractError, ValueError)


# --- pings -------------------------------------------------------------------------------------------


@given(seqs, times, st.text(st.characters(), max_size=20), st.none() | st.integers(0, 2**53))
def test_pong_round_trip(ping_id, sent_us, padding, received_ms):
    message = contract.encode_ping(ping_id, sent_us, padding)
    if received_ms is not None:  # as the rule does
        message = json.dumps(dict(json.loads(message), received_ms=received_ms)).encode()
    assert contract.decode_pong(message) == (ping_id, sent_us, received_ms)


@pytest.mark.parametrize(
    ("ping_id", "sent_us"),
    [(math.nan, 0), (-1, 0), (2**53 + 1, 0), (True, 0), ("1", 0), (1, math.nan), (1, 2**53)],
)
def test_ping_refused(ping_id, sent_us):
    with pytest.raises(ContractError, match=r"ping id|sent_us"):
        contract.encode_ping(ping_id, sent_us)


@pytest.mark.parametrize(
    "pong", ["{}", '{"id":1}', '{"id":"1","sent_us":0}', '{"id":1,"sent_us":0,"received_ms":null}', "[]"]
)
def test_pong_refused(pong):
    with pytest.raises(ContractError):
        contract.decode_pong(pong)


# --- names and topics ----------------------------------------------------------------------------------

HOSTILE = [
    "",
    "+",
    "#",
    "car/+",
    "car#",
    "a/b",
    "/",
    "$aws",
    "car\n",
    "\ncar",
    "car\0",
    " car",
    "car car",
    "car.1",
    "a" * 65,
    "größe",
    "car٣",
    "\uff43ar",
    "${topic(3)}",
    "car'; DROP",
    "*",
    ",",
    "\ud800",
    None,
    7,
    b"car",
    ["car"],
]


@given(st.sampled_from(contract.LANES), robots, robots, namespaces)
def test_topic_round_trip(lane, robot, name, namespace):
    topic = contract.build_topic(lane, robot, name, namespace)
    parsed = contract.parse_topic(topic)
    assert parsed == (lane, namespace, robot, name)
    assert str(parsed) == topic
    assert len(topic.encode()) <= 256, "the topic limit of AWS IoT Core"


@given(robots, robots, namespaces)
def test_record_topic_is_basic_ingest_to_the_record_rule(robot, stream, namespace):
    dollar_aws, rules, rule, rest = contract.record_topic(robot, stream, namespace).split("/", 3)
    assert (dollar_aws, rules, rule) == ("$aws", "rules", contract.rule_name("record", namespace))
    assert contract.parse_topic(rest) == ("dt", namespace, robot, stream)


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_hostile_names_are_refused_everywhere(name):
    for refused in (
        lambda: contract.check_robot(name),
        lambda: contract.check_stream(name),
        lambda: contract.check_namespace(name),
        lambda: contract.build_topic("dt", name, "vesc"),
        lambda: contract.build_topic("dt", "car", name),
        lambda: contract.build_topic("dt", "car", "vesc", name),
        lambda: contract.build_topic(name, "car", "vesc"),
        lambda: contract.record_topic(name, "vesc"),
        lambda: (
            contract.parse_topic(f"dt/iort/{name}/vesc")
            if isinstance(name, str)
            else contract.parse_topic(name)
        ),
        lambda: contract.channel(name),
        lambda: contract.rule_name(name),
        lambda: contract.rule_name("record", name),
        lambda: contract.rule_sql(name),
        lambda: contract.rule_sql("record", name),
        lambda: contract.pong_template(name),
        lambda: contract.pubnub_parameter(name),
        lambda: contract.fleet_name(name),
    ):
        with pytest.raises(ContractError):
            refused()


@given(st.text(st.characters(), max_size=70))
def test_any_name_is_refused_or_safe(name):
    try:
        contract.check_robot(name)
    except ContractError:
        return
    assert set(name.encode("ascii")) <= set(
        b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-"
    )
    assert 1 <= len(name) <= 64


@given(st.text(st.characters(), max_size=40) | robots.map("dt/iort/{}/vesc".format))
def test_any_topic_is_refused_or_built_alike(topic):
    try:
        parsed = contract.parse_topic(topic)
    except ContractError:
        return
    assert contract.build_topic(parsed.lane, parsed.robot, parsed.name, parsed.namespace) == topic


@pytest.mark.parametrize("namespace", ["Iort", "1iort", "io-rt", "io_rt", "a" * 17])
def test_namespace_is_stricter(namespace):
    with pytest.raises(ContractError, match="namespace"):
        contract.check_namespace(namespace)


# --- rules -----------------------------------------------------------------------------------------------


def matches(pattern, topic):
    """MQTT's wildcards, without ``#``, which no rule of ours uses."""
    levels, wanted = topic.split("/"), pattern.split("/")
    return len(levels) == len(wanted) and all(map(lambda w, level: w in ("+", level), wanted, levels))


RULE_TOPICS = {
    "record": ("dt", "vesc"),
    "live": ("live", "vesc"),
    "pong": ("ping", "rule"),
    "echo": ("ping", "lambda"),
    "upload": ("ping", "file"),
}


@pytest.mark.parametrize("rule", RULE_TOPICS)
@pytest.mark.parametrize("namespace", ["iort", "stage2"])
def test_rule_listens_to_its_own_topics_of_the_contract(rule, namespace):
    sql = contract.rule_sql(rule, namespace)
    [pattern] = re.findall(r"FROM '([^']*)'", sql)
    assert pattern.split("/")[:2] == [RULE_TOPICS[rule][0], namespace]
    every = [
        (lane, name) for lane in contract.LANES for name in ("vesc", contract.FILE, *contract.PING_PATHS)
    ]
    heard = {
        pair for pair in every if matches(pattern, contract.build_topic(pair[0], "car", pair[1], namespace))
    }
    lane, name = RULE_TOPICS[rule]
    expected = {(lane, name)} if lane == "ping" else {pair for pair in every if pair[0] == lane}
    assert heard == expected
    assert not matches(pattern, contract.build_topic(lane, "car", name, "other"))


@pytest.mark.parametrize("rule", RULE_TOPICS)
def test_what_the_cloud_says_overrides_the_message(rule):
    sql = contract.rule_sql(rule)
    # Lambda 1 alone is given the message as it came.
    whole = f"encode(*, 'base64') AS {contract.MESSAGE_BASE64}" if rule == "live" else "*"
    assert sql.startswith(f"SELECT {whole}, ")
    selected = ["*", *sql[len(f"SELECT {whole}, ") : sql.index(" FROM ")].split(", ")]
    named = [part.rsplit(" AS ", 1)[1] for part in selected[1:]]
    assert contract.RECEIVED_MS in named
    assert (contract.TOPIC in named) == (rule != "pong")
    assert (contract.EXPIRES_S in named) == (rule == "record")
    functions = set(re.findall(r"([a-zA-Z_]+)\(", sql))
    assert functions <= {"topic", "timestamp", "floor", "encode"}


def test_pong_goes_to_the_robot_that_asked():
    topic = contract.pong_template("iort").replace("${topic(3)}", "car")
    assert topic == contract.build_topic(contract.PONG, "car", contract.RULE)


def test_rule_names_are_allowed_by_aws():
    for namespace in ("iort", "a" * 16):
        for rule in contract.RULES:
            assert re.fullmatch(r"[a-zA-Z0-9_]{1,128}", contract.rule_name(rule, namespace))


def test_metric_names_are_unique():
    every = [name for group in contract.METRICS.values() for name in group]
    assert len(every) == len(set(every))


# --- the field table ---------------------------------------------------------------------------------------

# The messages of the drivers, in their order.
ROS1 = [
    "voltage_input",
    "temperature_pcb",
    "current_motor",
    "current_input",
    "speed",
    "duty_cycle",
    "charge_drawn",
    "charge_regen",
    "energy_drawn",
    "energy_regen",
    "displacement",
    "distance_traveled",
    "fault_code",
]
ROS2 = [
    "temp_fet",
    "temp_motor",
    "current_motor",
    "current_input",
    "avg_id",
    "avg_iq",
    "duty_cycle",
    "speed",
    "voltage_input",
    "charge_drawn",
    "charge_regen",
    "energy_drawn",
    "energy_regen",
    "displacement",
    "distance_traveled",
    "fault_code",
    "pid_pos_now",
    "controller_id",
    "ntc_temp_mos1",
    "ntc_temp_mos2",
    "ntc_temp_mos3",
    "avg_vd",
    "avg_vq",
]
UNITS = {"V", "A", "degC", "1", "erpm", "1e-4 Ah", "1e-4 Wh", "counts", "enum", "deg", "id"}


@pytest.mark.parametrize(("version", "expected"), [(1, ROS1), (2, ROS2)])
def test_fields_are_those_of_the_message(version, expected):
    assert {name for name, field in contract.VESC_FIELDS.items() if version in field.ros} == set(expected)


def test_ros1_message_has_13_fields():
    assert len(ROS1) == len(set(ROS1)) == 13


@pytest.mark.parametrize("field", contract.VESC_FIELDS.values(), ids=lambda field: field.name)
def test_field(field):
    assert contract.VESC_FIELDS[field.name] is field
    assert contract.encode(Batch(BOOT, 0, [0], {field.name: [0]}))
    assert field.unit in UNITS
    assert field.meaning.strip() == field.meaning != ""
    assert set(field.ros) <= {1, 2}
    assert (field.ros2_unit in {"Ah", "Wh"}) == field.unit.startswith("1e-4")
    assert field.ros


def test_faults_are_the_firmwares_whole_list():
    assert list(contract.FAULTS) == list(range(34))
    assert contract.FAULT_CODES["OVER_TEMP_FET"] == contract.FAULT_CODES["OVER_TEMP_MOTOR"] - 1 == 5
    assert contract.FAULT_CODES["ABS_OVERSPEED"] == 33
    assert len(set(contract.FAULTS.values())) == 34
    assert set(contract.FAULT_CODES.values()) == contract.FAULTS.keys()


def test_live_update_carries_every_hop():
    live = LiveSample(BOOT, 9, 1_000, 2_000, {"speed": 1})
    update = contract.live_update("car", "vesc", live, 3, 4_000)
    hops = {"sent_us": 2_000, "received_ms": 3, "lambda_us": 4_000}
    assert update["hops"] == hops
    known = contract.live_update("car", "vesc", replace(live, offset_us=-5), 3, 4_000)
    assert known["hops"] == {**hops, "offset_us": -5}
    assert (update["robot"], update["stream"], update["t"], update["seq"]) == ("car", "vesc", 1_000, 9)
    assert update["sample"] == {"speed": 1}
    full = dict.fromkeys(contract.VESC_FIELDS, -1234.56789)
    largest = contract.live_update("c" * 64, "vesc", replace(live, sample=full), 2**53, 2**53)
    assert len(json.dumps(largest)) * 3 < contract.MAX_PUBNUB_BYTES


def test_dataclasses_are_frozen():
    for one in (GOOD, GOOD_LIVE):
        with pytest.raises(AttributeError):
            setattr(one, fields(one)[0].name, "x")
