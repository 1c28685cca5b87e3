"""ROS messages in batches, as columns or as published bytes, are restored byte for byte."""

from __future__ import annotations

import base64
import json
import math
import random
import struct
import zlib
from typing import Any, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.codec import CODEC, DICTIONARY, ROS1_CODEC, inflate
from iort_contract.limits import (
    MAX_BATCH_VALUES,
    MAX_COLUMNS_BYTES,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    ContractError,
    MessageError,
)
from iort_contract.messages.batch import Batch, decode_batch, encode_batch, messages_of, split_batch
from iort_contract.ros.columns import as_columns, decoder_of, from_columns, view
from iort_contract.ros.decode import HEADER as HEAD
from iort_contract.ros.decode import Large
from iort_contract.ros.definition import layout, parse
from iort_contract.ros.message import (
    MAX_LAYOUT,
    Messages,
    MessageType,
    RosMessage,
    RosType,
    cut,
    filled,
    pack,
    type_id,
    unpack,
)
from tests.examples import examples
from tests.unit.contract.contract_values import BOOT, json_values
from tests.unit.contract.ros.ros1_messages import HEADER, LINE, STAMPED, header, text, u32

T0 = 1_700_000_000_000_000
FLAT = RosType("/flat", "a_msgs/Flat", "1", "float64 x\nfloat32 y\nint16 n\nbool on\nuint64 big")
STAMPED_FLAT = RosType("/stamped", "a_msgs/S", "2", "Header header\nfloat64 x\nuint8 n" + HEADER)
NAMES = RosType("/names", "a_msgs/N", "3", "string[] names\nfloat64[] x")
EMPTY = RosType("/empty", "std_msgs/Empty", "4", "")
ONLY_HEADER = RosType("/h", "std_msgs/Header", "5", "uint32 seq\ntime stamp\nstring frame_id\n")
UNKNOWN = RosType("/unknown", "a_msgs/U", "6", "this is no definition")
KINDS = {kind.id: kind for kind in (FLAT, STAMPED_FLAT, NAMES, EMPTY, ONLY_HEADER, UNKNOWN)}
LAYOUTS = {name: kind.layout for name, kind in KINDS.items() if kind.layout}


def batch_of(kind: RosType, raws: Sequence[bytes], beside: Any = None, step_us: int = 1000) -> Batch:
    times = [T0 + i * step_us for i in range(len(raws))]
    return Batch(BOOT, 4, times, beside or {}, 0, Messages(kind.id, kind.layout, raws))


def codec_of(batch: Batch) -> str:
    return str(json.loads(encode_batch(batch))["codec"])


def again(batch: Batch, layouts: Any = None) -> list[bytes]:
    """The messages decoded from the wire's batch and from a table's item."""
    message = encode_batch(batch)
    _, messages = messages_of(message, LAYOUTS if layouts is None else layouts)
    assert messages.type_id == batch.messages.type_id
    return list(messages.raw)


def flat(x: float = 1.5, y: float = 0.5, n: int = 3, on: int = 1) -> bytes:
    return struct.pack("<dfhBQ", x, y, n, on, 2**63)


def stamped(i: int, *, ns: int = 250, frame: str = "base_link", off_us: int = 0) -> bytes:
    sec, us = divmod(T0 + i * 1000 + off_us, 1_000_000)
    return header_of(7 + i, sec, us * 1000 + ns, frame) + struct.pack("<dB", i / 4, i % 256)


def header_of(seq: int, sec: int, nanosec: int, frame: str) -> bytes:
    return HEAD.pack(seq, sec, nanosec, len(frame.encode())) + frame.encode()


# --- columns ----------------------------------------------------------------------------------------


def test_numeric_messages_are_stored_as_columns_and_restored_byte_for_byte() -> None:
    batch = batch_of(FLAT, [flat(x=i / 10, n=i, on=i % 2) for i in range(50)])
    assert codec_of(batch) == CODEC
    decoded = decode_batch(encode_batch(batch))
    assert decoded.messages is None
    assert list(decoded.columns) == ["x", "y", "n", "on", "big"]
    assert decoded.columns["x"] == [i / 10 for i in range(50)]
    assert decoded.columns["on"] == [bool(i % 2) for i in range(50)]
    assert decoded.columns["big"] == [2**63] * 50
    assert again(batch) == batch.messages.raw  # type: ignore[union-attr]  # messages were given


# A column would change the bits of these values, so their messages are kept as bytes.
QUIET, SIGNALLING = 0x7FF8000000000001, 0x7FF0000000000001


@pytest.mark.parametrize(
    "odd",
    [
        flat(x=math.nan),
        flat(x=struct.unpack("<d", struct.pack("<Q", QUIET))[0]),
        struct.pack("<QfhBQ", SIGNALLING, 0, 0, 0, 0),
        flat(x=math.inf),
        flat(y=-math.inf),
        flat(x=-0.0),
        flat(y=-0.0),
        flat(on=2),
        flat(on=255),
        flat()[:-1],
        flat() + b"\0",
        b"",
    ],
    ids=["NaN", "quiet NaN", "signalling NaN", "infinity", "float32 infinity", "negative zero",
         "float32 negative zero", "a bool of 2", "a bool of 255", "cut", "longer", "empty"],
)  # fmt: skip
def test_messages_that_a_column_would_change_are_kept_as_bytes(odd: bytes) -> None:
    raws = [flat(), odd, flat(n=4)]
    batch = batch_of(FLAT, raws)
    assert codec_of(batch) == ROS1_CODEC
    # The batch itself contains the layout.
    assert again(batch, {}) == raws
    decoded = decode_batch(encode_batch(batch))
    assert decoded.columns["n"][::2] == [3, 4]


@examples(200)
@given(st.lists(st.binary(min_size=23, max_size=23), min_size=1, max_size=8))
def test_any_bytes_of_a_numeric_type_are_restored(raws: list[bytes]) -> None:
    batch = batch_of(FLAT, raws)
    assert again(batch) == raws
    decoded = decode_batch(encode_batch(batch))
    expected, nulled = view(Messages(FLAT.id, FLAT.layout, raws))
    assert (decoded.columns, decoded.nonfinite) == (expected, nulled)


@pytest.mark.parametrize(
    "raws",
    [
        [stamped(i) for i in range(20)],
        [stamped(i, ns=i) for i in range(20)],
        [stamped(i, frame=["laser", "map"][i % 2]) for i in range(20)],
        [stamped(i, frame="") for i in range(20)],
        [stamped(i, frame="grün\n\0") for i in range(20)],
        [stamped(i, off_us=-5_000_000) for i in range(20)],
        [stamped(i, off_us=30 * i) for i in range(20)],
        [header_of(i * 2**27, 0, 0, "a") + bytes(9) for i in range(20)],
        [header_of(2**32 - 1, 2**32 - 1, 999_999_999, "a") + bytes(9)],
    ],
    ids=["plain", "ns", "frames", "no frame", "odd frame", "seconds off", "drift", "no stamp", "greatest"],
)
def test_any_valid_header_is_restored(raws: list[bytes]) -> None:
    batch = batch_of(STAMPED_FLAT, raws)
    assert codec_of(batch) == CODEC
    assert again(batch) == raws
    assert list(decode_batch(encode_batch(batch)).columns) == ["x", "n"]


@pytest.mark.parametrize(
    "odd",
    [
        HEAD.pack(1, 5, 6, 2) + b"\xff\xfe" + bytes(9),
        HEAD.pack(1, 5, 10**9, 1) + b"a" + bytes(9),
        HEAD.pack(1, 5, 2**32 - 1, 1) + b"a" + bytes(9),
        HEAD.pack(1, 5, 6, 2**32 - 1) + b"a" + bytes(9),
        HEAD.pack(1, 5, 6, 0)[:15],
        b"",
    ],
    ids=["no UTF-8", "a second of nanoseconds", "many nanoseconds", "a long frame", "cut", "empty"],
)
def test_an_invalid_header_is_restored(odd: bytes) -> None:
    batch = batch_of(STAMPED_FLAT, [stamped(0), odd])
    assert codec_of(batch) == ROS1_CODEC
    assert again(batch, {}) == [stamped(0), odd]


def test_columns_are_smaller_than_the_messages_bytes() -> None:
    """Smooth numbers of a drive are stored as columns; noise is kept as bytes, half as long as its text."""
    smooth = batch_of(STAMPED_FLAT, [stamped(i, ns=i * 7 % 1000) for i in range(500)])
    assert codec_of(smooth) == CODEC
    raws = smooth.messages.raw  # type: ignore[union-attr]  # messages were given
    packed = len(zlib.compress(pack(Messages(STAMPED_FLAT.id, STAMPED_FLAT.layout, raws))))
    assert len(encode_batch(smooth)) * 3 // 4 < packed
    noise = random.Random(1)
    noisy = batch_of(FLAT, [flat(x=noise.random()) for _ in range(50)])
    assert codec_of(noisy) == ROS1_CODEC


def test_the_layout_must_be_known_and_fit_the_columns() -> None:
    batch = batch_of(FLAT, [flat()])
    message = encode_batch(batch)
    with pytest.raises(ContractError, match=f"type .{FLAT.id}. is unknown"):
        messages_of(message, {})
    for wrong, named in (
        (STAMPED_FLAT.layout, "the columns do not fit the type"),
        (NAMES.layout, "must consist of numbers"),
        ("a_msgs/A\nnonsense", "invalid line"),
        ("a_msgs/A\n" + "#" * MAX_LAYOUT, "must be at most"),
    ):
        with pytest.raises(ContractError, match=named):
            messages_of(message, {FLAT.id: wrong})


def test_samples_without_messages_decode_without_messages() -> None:
    batch = Batch(BOOT, 0, [T0], {"x": [1]})
    assert messages_of(encode_batch(batch), LAYOUTS) == (batch, None)


# The description of messages after the columns of a batch of two samples.
ABOUT = {"type": STAMPED_FLAT.id, "seq": 1, "stamp": "000000", "frame_id": "a"}


def _about(**changes: Any) -> str:
    return json.dumps(list({**ABOUT, **changes}.values()))


WRONG_ABOUT = [
    "",
    "[]",
    "{}",
    "[" * 100_000,
    "[NaN]",
    json.dumps([STAMPED_FLAT.id]),
    json.dumps([*ABOUT.values(), 1]),
    json.dumps(ABOUT),
    *(
        _about(**change)
        for change in (
            {"type": None},
            {"seq": None},
            {"seq": -1},
            {"seq": 2**32},
            {"seq": "1"},
            {"seq": [0, -1, 0]},
            {"seq": [0, 2**32, 0]},
            {"seq": [1, 5, 5]},
            {"stamp": ""},
            {"stamp": "abcdef"},
            {"stamp": 7},
            {"stamp": [None, None, None]},
            {"frame_id": None},
            {"frame_id": ["a", "b", "c"]},
            {"frame_id": [None, None]},
            {"frame_id": ["\ud800"]},
        )
    ),
]


@pytest.mark.parametrize("about", WRONG_ABOUT, ids=range(len(WRONG_ABOUT)))
def test_an_invalid_description_of_messages_is_refused(about: str) -> None:
    with pytest.raises(ContractError):
        from_columns({"x": [1.5, 2.5], "n": [1, 2]}, about, [T0, T0 + 1], LAYOUTS)


@given(json_values | st.dictionaries(st.sampled_from(sorted(ABOUT)), json_values))
def test_any_json_after_the_columns_gives_messages_or_is_refused(value: Any) -> None:
    known = isinstance(value, dict) and value.keys() <= ABOUT.keys()
    about = _about(**value) if known else json.dumps(value)
    try:
        made = from_columns({"x": [1.5, 2.5], "n": [1, 2]}, about, [T0, T0 + 1], LAYOUTS)
    except ContractError:
        return
    assert len(made.raw) == 2


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"x": [1.5, 2.5]},
        {"x": [1.5, 2.5], "n": [1, 2], "more": [1, 2]},
        {"x": [None, 2.5], "n": [1, 2]},
        {"x": [1.5, 2.5], "n": [256, 2]},
        {"x": [1.5, 2.5], "n": [-1, 2]},
        {"x": [1.5, 2.5], "n": [0.5, 2]},
    ],
)
def test_columns_that_do_not_fit_the_type_are_refused(columns: Any) -> None:
    with pytest.raises(ContractError, match="the columns do not fit the type"):
        from_columns(columns, _about(), [T0, T0 + 1], LAYOUTS)


def test_a_long_frame_id_is_not_repeated_for_each_sample() -> None:
    """The frame id compresses to kilobytes, but each sample's message would repeat it."""
    frame, n = "x" * 1_000_000, 50_000
    about = _about(stamp="000" * n, frame_id=frame)
    with pytest.raises(ContractError, match="frame_id"):
        from_columns({"x": [0.5] * n, "n": [0] * n}, about, range(T0, T0 + n), LAYOUTS)
    for size, n, codec in (
        (1_000_000, 1, "ros1"),
        (1_000_000, 2, "ros1"),
        (100_000, 2, "steps"),
        (9, 9, "steps"),
    ):
        batch = batch_of(STAMPED_FLAT, [header_of(i, 5, 0, "\0" * size) + bytes(9) for i in range(n)])
        assert codec_of(batch) == codec
        assert again(batch) == batch.messages.raw  # type: ignore[union-attr]  # messages were given


def test_a_field_with_too_long_a_name_is_stored_without_a_column() -> None:
    name = "a" * (MAX_FIELD_CHARACTERS + 1)
    kind = RosType("/t", "a_msgs/A", "1", f"float64 {name}\nuint8 n")
    raws = [struct.pack("<dB", 0.5, i) for i in range(3)]
    batch = batch_of(kind, raws)
    assert again(batch, {kind.id: kind.layout}) == raws
    assert dict(decode_batch(encode_batch(batch)).columns) == {"n": [0, 1, 2]}


def test_messages_with_too_long_a_definition_are_stored_without_columns() -> None:
    definition = "".join(f"float64 {'a' * 1000}{i}\n" for i in range(100))
    kind = RosType("/t", "a_msgs/A", "1", definition)
    raws = [bytes([i]) * 800 for i in range(3)]
    batch = batch_of(kind, raws)
    assert again(batch, {}) == raws
    assert kind.layout == ""
    assert "characters" in kind.error


# --- as they were published -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "raws"),
    [
        (NAMES, [u32(2) + text("a") + text("ü") + u32(0), u32(0) + u32(1) + struct.pack("<d", 0.5)]),
        (NAMES, [u32(0) + u32(0)] * 9),
        (EMPTY, [b"", b"", b""]),
        (EMPTY, [b""]),
        (EMPTY, [b"", b"not empty"]),
        (ONLY_HEADER, [header(i, 5) for i in range(3)]),
        (UNKNOWN, [b"anything", b"", b"else"]),
        (UNKNOWN, [bytes(range(256)) * 300]),
        (NAMES, [b"\n", b"\n\n", b"{}\n"]),
    ],
)  # fmt: skip
def test_other_messages_are_kept_byte_for_byte(kind: RosType, raws: list[bytes]) -> None:
    batch = batch_of(kind, raws)
    assert codec_of(batch) == ROS1_CODEC
    assert again(batch, {}) == raws


def test_missing_array_elements_are_null_in_the_view() -> None:
    raws = [u32(2) + text("a") + text("b") + u32(0), u32(1) + text("c") + u32(1) + struct.pack("<d", 0.5)]
    found = decode_batch(encode_batch(batch_of(NAMES, raws)))
    assert found.columns == {"names.0": ["a", "c"], "names.1": ["b", None], "x.0": [None, 0.5]}
    assert found.messages is not None
    assert found.times_us == [T0, T0 + 1000]


def test_nonfinite_values_are_counted_in_the_view() -> None:
    raws = [flat(x=math.nan), flat(x=-0.0), flat(y=math.inf)]
    found = decode_batch(encode_batch(batch_of(FLAT, raws)))
    assert (found.columns["x"], found.columns["y"]) == ([None, 0, 1.5], [0.5, 0.5, None])
    assert found.nonfinite == 2


def test_columns_beside_messages_are_part_of_their_samples() -> None:
    raws = [u32(0) + u32(0), u32(1) + text("a") + u32(0)]
    batch = batch_of(NAMES, raws, {"data.key": ["k", None], "data.at": [0, 4]})
    beside, messages = messages_of(encode_batch(batch), {})
    assert beside.columns == {"data.key": ["k", None], "data.at": [0, 4]}
    assert decode_batch(encode_batch(batch)).columns == {"names.0": [None, "a"], **beside.columns}
    assert list(messages.raw) == raws
    # Numeric messages, too.
    numbers = batch_of(FLAT, [flat()], {"note": ["n"]})
    assert codec_of(numbers) == ROS1_CODEC
    assert again(numbers, {}) == [flat()]


def test_each_half_of_a_batch_keeps_its_messages() -> None:
    batch = batch_of(NAMES, [u32(0) + u32(0)] * 3, {"note": ["a", "b", "c"]})
    first, second = split_batch(batch)
    assert (len(again(first, {})), len(again(second, {}))) == (1, 2)
    assert decode_batch(encode_batch(second)).columns["note"] == ["b", "c"]
    with pytest.raises(ContractError, match="1 samples must have as many messages, got 2"):
        encode_batch(Batch(BOOT, 0, [T0], {}, 0, Messages(NAMES.id, "", [b"", b""])))


def test_messages_too_large_for_a_batch_are_split_into_readable_halves() -> None:
    batch = batch_of(UNKNOWN, [b"x" * 700_000] * 4)
    with pytest.raises(ContractError, match="messages of a batch must be at most 2097152 bytes, got 2800000"):
        encode_batch(batch)
    for half in split_batch(batch):
        assert again(half, {}) == [b"x" * 700_000] * 2
    alone = batch_of(UNKNOWN, [b"x" * MAX_COLUMNS_BYTES])
    assert again(alone, {}) == [b"x" * MAX_COLUMNS_BYTES]


@examples(200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=6), st.text(max_size=9), st.text(max_size=9))
def test_any_messages_are_unpacked_as_they_were_packed(raws: list[bytes], type_id: str, about: str) -> None:
    found = unpack(pack(Messages(type_id, about, raws)), len(raws))
    assert (found.type_id, found.layout, list(found.raw)) == (type_id, about, raws)


def head(**changes: Any) -> bytes:
    good = {"type": "0123abcd", "layout": "", "sizes": [1, 2]}
    return json.dumps({**good, **changes}).encode() + b"\n" + b"abc"


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (b"", "must have a head"),
        (b"abc", "must have a head"),
        (b"\n", "not JSON"),
        (b"[]\nabc", "not a JSON object"),
        (b"[" * 100_000 + b"\n", "nested too deeply|not JSON"),
        (b" " * 1_100_000 + b"{}\nabc", "must have a head"),
        (b"{}\nabc", "must have a type and a layout"),
        (head(type=7), "must have a type and a layout"),
        (head(layout=None), "must have a type and a layout"),
        (head(sizes=None), "sizes must be 2 integers"),
        (head(sizes=[3]), "sizes must be 2 integers"),
        (head(sizes=[4, -1]), "sizes must be 2 integers"),
        (head(sizes=[1.0, 2]), "sizes must be 2 integers"),
        (head(sizes=[True, 2]), "sizes must be 2 integers"),
        (head(sizes=[1, 1]), "must be 2 bytes by their sizes"),
        (head(sizes=True), "sizes must be 2 integers"),
        (head(sizes=0), "must be 2 of 0"),
        (head(sizes=-3), "must be 2 of -3"),
        (head(sizes=2), "must be 2 of 2"),
    ],
)
def test_an_invalid_head_is_refused(body: bytes, named: str) -> None:
    with pytest.raises(ContractError, match=named):
        unpack(body, 2)


def test_the_part_after_the_columns_must_be_text() -> None:
    good = json.loads(encode_batch(batch_of(FLAT, [flat()])))
    body = inflate(good["samples"], CODEC)
    for behind, taken in ((b"[1]", True), (b"\xff\xfe", False)):
        deflater = zlib.compressobj(zdict=DICTIONARY)
        packed = deflater.compress(body.partition(b"\n")[0] + b"\n" + behind) + deflater.flush()
        envelope = {**good, "samples": base64.b64encode(packed).decode()}
        if taken:
            assert decode_batch(envelope).columns["x"] == [1.5]
        else:
            with pytest.raises(ContractError, match="must be text"):
                decode_batch(envelope)


@examples(200)
@given(st.sampled_from([FLAT, STAMPED_FLAT, NAMES]), st.data())
def test_a_damaged_batch_of_messages_is_read_or_refused(kind: RosType, data: Any) -> None:
    raws = {FLAT: [flat()] * 2, STAMPED_FLAT: [stamped(0), stamped(1)], NAMES: [u32(0, 0)] * 2}[kind]
    envelope = json.loads(encode_batch(batch_of(kind, raws)))
    body = bytearray(inflate(envelope["samples"], envelope["codec"]))
    at = data.draw(st.integers(0, len(body) - 1))
    body[at] = data.draw(st.integers(0, 255))
    for damaged in (bytes(body), bytes(body[:at])):
        deflater = zlib.compressobj(zdict=DICTIONARY)
        packed = base64.b64encode(deflater.compress(damaged) + deflater.flush()).decode()
        for codec in (CODEC, ROS1_CODEC):
            try:
                _, messages = messages_of({**envelope, "codec": codec, "samples": packed}, LAYOUTS)
            except ContractError:
                continue
            assert messages is None or len(messages.raw) == 2


def test_a_message_of_millions_of_values_gives_a_bounded_view() -> None:
    """Even in a hostile batch, only the values that the view may show are decoded."""
    kind = RosType("/t", "a_msgs/A", "1", "B[] b\n" + LINE + "MSG: a_msgs/B\nint8[] a\n")
    one = u32(64) + (u32(64) + bytes(64)) * 64
    batch = batch_of(kind, [one] * 400)
    found = decode_batch(json.dumps(json.loads(forced(batch))))
    assert len(found.columns) <= MAX_FIELDS
    assert sum(len(column) - column.count(None) for column in found.columns.values()) <= (
        2 * MAX_BATCH_VALUES + MAX_FIELDS
    )
    assert list(found.messages.raw) == [one] * 400


def forced(batch: Batch) -> bytes:
    """The batch as an encoder without the limit of values writes it."""
    dt = [0] + [1000] * (len(batch.times_us) - 1)
    deflater = zlib.compressobj(zdict=DICTIONARY)
    body = json.dumps({"dt": dt, "fields": {}}).encode() + b"\n" + pack(batch.messages)
    samples = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    envelope = {"v": 2, "batch": str(batch.id), "n": len(dt), "codec": "ros1", "samples": samples}
    return json.dumps(envelope).encode()


def test_a_batch_with_too_many_values_is_split_into_halves() -> None:
    kind = RosType("/t", "a_msgs/A", "1", "".join(f"uint8[64] a{i}\n" for i in range(8)))
    batch = batch_of(kind, [bytes(512)] * 98)
    with pytest.raises(ContractError, match="98 samples of 512 fields"):
        encode_batch(batch)
    for half in split_batch(batch):
        assert again(half, {kind.id: kind.layout}) == [bytes(512)] * 49


# --- types ------------------------------------------------------------------------------------------


NESTED = (
    "# A comment\nuint8 KIND=3 # of what\nHeader header\nB[2] b\nstring[] s\ntime t\nother_msgs/C c\n"
    + HEADER + LINE + "MSG: a_msgs/B\nfloat32 x # comment\nC c\n" + LINE + "MSG: a_msgs/C\nint8 i\n"
    + LINE + "MSG: other_msgs/C\nduration d\nuint8[] u\n" + LINE + "MSG: a_msgs/Unused\nint8 i\n"
)  # fmt: skip


@pytest.mark.parametrize("definition", ["", "uint8 a", NESTED, STAMPED + "uint8 u"])
def test_a_layout_is_sufficient_for_decoding(definition: str) -> None:
    parsed = parse("a_msgs/A", definition)
    written = layout(parsed)
    read = parse("a_msgs/A", written)
    assert read.fields() == parsed.fields()
    assert {name: read.types[name] for name in read.types} == {
        name: parsed.types[name] for name in read.types
    }
    assert layout(read) == written
    assert "#" not in written
    assert "KIND" not in written


def test_topic_name_and_checksum_identify_a_type() -> None:
    named = {
        type_id(*one) for one in [("/a", "b", "c"), ("/a", "b", "d"), ("/a", "c", "c"), ("", "/ab", "c")]
    }
    assert len(named) == 4
    assert all(len(name) == 8 and int(name, 16) >= 0 for name in named)
    said = MessageType("s", "/flat", "a_msgs/Flat", "1", "float64 x # with a comment")
    assert said.id == RosType("/flat", "a_msgs/Flat", "1", "").id == FLAT.id
    assert said.layout == "a_msgs/Flat\nfloat64 x\n"
    assert MessageType("s", "/t", "k", "1", "no definition at all").layout == ""


def test_a_message_decodes_its_fields_on_access() -> None:
    message = RosMessage(flat(), FLAT, beside={"note": "n"})
    assert dict(message) == {"x": 1.5, "y": 0.5, "n": 3, "on": True, "big": 2**63, "note": "n"}
    assert (len(message), message["n"], "note" in message) == (6, 3, True)
    assert dict(RosMessage(b"short", FLAT)) == {}
    assert dict(RosMessage(b"any", UNKNOWN)) == {}
    assert "invalid line" in UNKNOWN.error


@given(st.binary(max_size=30), st.binary(min_size=1, max_size=9), st.binary(max_size=30))
def test_a_content_that_was_cut_out_is_restored(before: bytes, content: bytes, after: bytes) -> None:
    raw = before + u32(len(content)) + content + after
    less, at = cut(raw, Large(content, len(before)))
    assert len(less) == len(raw) - len(content)
    assert filled(less, content, at) == raw


@pytest.mark.parametrize("at", [-1, 1, 3, 100])
def test_a_content_is_restored_only_at_an_empty_array(at: int) -> None:
    with pytest.raises(MessageError, match=f"no empty array at byte {at}"):
        filled(u32(0) + b"abc", b"x", at)


@pytest.mark.parametrize("wrong", ["", "\n", "a_msgs/A\nB b", "a_msgs/A\nfloat64", "x" * (MAX_LAYOUT + 1)])
def test_an_invalid_layout_is_refused(wrong: str) -> None:
    kind = Messages("0123abcd", wrong, [b""])
    if wrong.strip():
        with pytest.raises(MessageError):
            decoder_of(wrong)
        with pytest.raises(ContractError):
            view(kind)
    else:
        assert view(kind) == ({}, 0)
    assert as_columns(Messages("0123abcd", "", [b""]), [T0]) is None
