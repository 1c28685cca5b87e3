"""Messages of ROS 2 in batches, as columns or as published bytes, are restored byte for byte."""

from __future__ import annotations

import json
import math
import random
import struct
from typing import Any, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.codec import CODEC, ROS2_CODEC
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.batch import Batch, decode_batch, encode_batch, messages_of
from iort_contract.ros.columns import from_columns, view
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import parse
from iort_contract.ros.message import Messages, MessageType, RosMessage, RosType, cut, filled, message_type
from tests.examples import examples
from tests.unit.contract.contract_values import BOOT, json_values
from tests.unit.contract.ros.ros2_messages import HEADER, LINE, Cdr
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, text_of, values

T0 = 1_700_000_000_000_000
HASH = "RIHS01_" + "ab" * 32
FLAT = RosType(
    "/flat", "a_msgs/msg/Flat", HASH, "float64 x\nuint8 n\nfloat32 y\nbool on\nuint64 big\nuint8 last"
)
STAMPED = RosType("/stamped", "a_msgs/msg/S", HASH, f"std_msgs/Header header\nfloat64 x\nuint8 n{HEADER}")
NAMES = RosType("/names", "a_msgs/msg/N", HASH, "string[] names\nfloat64[] x")
HOLES = RosType("/holes", "a_msgs/msg/H", HASH, f"E e\nint8 a\nE[3] f\nint16 b\nE g\n{LINE}MSG: a_msgs/E\n")
EMPTY = RosType("/empty", "std_msgs/msg/Empty", HASH, "")
UNKNOWN = RosType("/unknown", "a_msgs/msg/U", HASH, "this is no definition")
LAYOUTS = {kind.id: kind.layout for kind in (FLAT, STAMPED, NAMES, HOLES, EMPTY, UNKNOWN)}


def batch_of(kind: RosType, raws: Sequence[bytes], step_us: int = 1000) -> Batch:
    times = [T0 + i * step_us for i in range(len(raws))]
    return Batch(BOOT, 4, times, {}, 0, Messages(kind.id, kind.layout, raws))


def again(kind: RosType, raws: Sequence[bytes], layouts: Any = None, **how: int) -> str:
    """The codec of a batch, which gives the same messages again."""
    message = encode_batch(batch_of(kind, raws, **how))
    _, messages = messages_of(message, LAYOUTS if layouts is None else layouts)
    assert messages is not None
    assert list(messages.raw) == list(raws)
    return str(json.loads(message)["codec"])


def flat(x: float = 1.5, n: int = 3, y: float = 0.5, on: int = 1, *, order: str = "<") -> bytes:
    return Cdr(order).put("d", x).put("B", n).put("f", y).put("B", on).put("Q", 2**63).put("B", 9).data


def stamped(i: int, *, ns: int = 250, frame: str = "base_link", off_us: int = 0) -> bytes:
    sec, us = divmod(T0 + i * 1000 + off_us, 1_000_000)
    return Cdr().header(sec, us * 1000 + ns, frame).put("d", i / 4).put("B", i % 256).data


def test_numeric_messages_are_stored_as_columns() -> None:
    raws = [flat(x=i / 10, n=i, on=i % 2) for i in range(50)]
    assert again(FLAT, raws) == CODEC
    decoded = decode_batch(encode_batch(batch_of(FLAT, raws)))
    assert decoded.messages is None
    assert list(decoded.columns) == ["x", "n", "y", "on", "big", "last"]
    assert decoded.columns["x"] == [i / 10 for i in range(50)]
    assert decoded.columns["on"] == [bool(i % 2) for i in range(50)]


GAPS = flat().index(b"\x03") + 1


@pytest.mark.parametrize(
    "raws",
    [
        [raw + bytes(-len(raw) % 4) for raw in map(flat, range(9))],
        [raw + b"\xff\xfe\xfd" for raw in map(flat, range(9))],
        # Fast DDS does not clear the gaps.
        [raw[:GAPS] + b"abc" + raw[GAPS + 3 :] for raw in map(flat, range(9))],
        [raw[:GAPS] + bytes([i]) + raw[GAPS + 1 :] for i, raw in enumerate(map(flat, range(9)))],
        [b"\0\1\0\3" + raw[4:] for raw in map(flat, range(9))],
        [bytes([0, 1, i, 0]) + raw[4:] for i, raw in enumerate(map(flat, range(9)))],
        [raw + bytes(-len(raw) % 4 * (i % 2)) for i, raw in enumerate(map(flat, range(9)))],
    ],
    ids=["filled up", "filled up with anything", "gaps", "a gap of each", "options", "options of each",
         "some filled up"],
)  # fmt: skip
def test_what_is_beside_the_numbers_is_restored(raws: list[bytes]) -> None:
    assert again(FLAT, raws) == CODEC


@pytest.mark.parametrize("hole", [0, 7])
def test_empty_messages_between_numbers_are_restored(hole: int) -> None:
    raws = [
        Cdr().put("B", hole).put("b", i).put("B", *[hole] * 3).put("h", -i).put("B", hole).data
        for i in range(9)
    ]
    assert again(HOLES, raws) == CODEC
    assert decode_batch(encode_batch(batch_of(HOLES, raws))).columns == {
        "a": list(range(9)),
        "b": [-i for i in range(9)],
    }


@pytest.mark.parametrize(
    "odd",
    [
        flat(x=math.nan),
        struct.pack("<4sQ", b"\0\1\0\0", 0x7FF0000000000001) + flat()[12:],
        flat(x=-0.0),
        flat(y=math.inf),
        flat(on=2),
        flat(order=">"),
        flat()[:-1],
        flat() + b"\0",
        flat() + bytes(4),
        b"",
        b"\0\1\0\0",
        b"\0\7" + flat()[2:],
    ],
    ids=["NaN", "signalling NaN", "negative zero", "infinity", "a bool of 2", "big-endian", "cut", "longer",
         "much longer", "empty", "only the start", "another encoding"],
)  # fmt: skip
def test_messages_that_a_column_would_change_are_kept_as_bytes(odd: bytes) -> None:
    raws = [flat(), odd, flat(n=4)]
    # The batch itself contains the layout.
    assert again(FLAT, raws, {}) == ROS2_CODEC
    assert decode_batch(encode_batch(batch_of(FLAT, raws))).columns["n"][::2] == [3, 4]


@examples(200)
@given(st.lists(st.binary(min_size=33, max_size=33), min_size=1, max_size=8), st.booleans())
def test_any_bytes_of_a_numeric_type_are_restored(bodies: list[bytes], little: bool) -> None:
    raws = [(b"\0\1\0\0" if little else b"") + body for body in bodies]
    again(FLAT, raws)
    decoded = decode_batch(encode_batch(batch_of(FLAT, raws)))
    expected, nulled = view(Messages(FLAT.id, FLAT.layout, raws))
    assert (decoded.columns, decoded.nonfinite) == (expected, nulled)


@pytest.mark.parametrize(
    "raws",
    [
        [stamped(i) for i in range(20)],
        [stamped(i, ns=i) for i in range(20)],
        [stamped(i, frame=["laser", "map", ""][i % 3]) for i in range(20)],
        [stamped(i, frame="grün\n") for i in range(20)],
        [stamped(i, frame="a\0b") for i in range(20)],
        [stamped(i, off_us=-5_000_000) for i in range(20)],
        [stamped(i, off_us=-(T0 + 10**6)) for i in range(20)],
        [stamped(i) + bytes(-len(stamped(i)) % 4) for i in range(20)],
    ],
    ids=["equal", "nanoseconds", "frames", "Unicode", "NUL", "late", "before 1970", "filled up"],
)
def test_any_valid_header_is_restored(raws: list[bytes]) -> None:
    assert again(STAMPED, raws) == CODEC


@pytest.mark.parametrize(
    "odd",
    [
        stamped(1, ns=999_999_999)[:8] + b"\xff\xff\xff\xff" + stamped(1)[12:],
        stamped(1).replace(b"base_link", b"base\xfflink"),
        stamped(1).replace(b"link\0", b"link!"),
        stamped(1)[:12] + bytes(4) + stamped(1)[16:20],
        Cdr().put("i", 1_700_000_000).put("I", 1_000_250, 0).put("d", 0.25).put("B", 1).data,
        stamped(1)[:14],
        stamped(1)[:12] + b"\xff\xff\xff\xff" + stamped(1)[16:],
    ],
    ids=[
        "nanoseconds",
        "no Unicode",
        "no NUL",
        "no text",
        "an empty text without its NUL",
        "cut",
        "a long frame_id",
    ],
)
def test_an_invalid_header_is_restored(odd: bytes) -> None:
    assert again(STAMPED, [stamped(0), odd, stamped(2)]) == ROS2_CODEC


@pytest.mark.parametrize("different", [1, 7])
def test_gaps_of_more_bytes_than_a_reader_takes_are_kept_as_bytes(different: int) -> None:
    kind = RosType("/gaps", "a_msgs/msg/G", HASH, "".join(f"bool b{i}\nfloat64 x{i}\n" for i in range(30)))
    raws = [
        b"\0\1\0\0"
        + b"".join(b"\1" + bytes([i % different] * 7) + struct.pack("<d", i / 4) for _ in range(30))
        for i in range(800)
    ]
    assert again(kind, raws, {kind.id: kind.layout}) == ROS2_CODEC
    assert again(kind, raws[::7], {kind.id: kind.layout}) == CODEC


def test_columns_are_smaller_than_the_messages_bytes() -> None:
    chance = random.Random(5)
    raws = [stamped(i, ns=chance.randrange(1000)) for i in range(100)]
    as_bytes = Messages(STAMPED.id, STAMPED.layout, raws)
    message = encode_batch(batch_of(STAMPED, raws))
    noisy = encode_batch(Batch(BOOT, 4, [T0 + i for i in range(100)], {"beside": [1] * 100}, 0, as_bytes))
    assert (json.loads(message)["codec"], json.loads(noisy)["codec"]) == (CODEC, ROS2_CODEC)
    assert len(message) < len(noisy) / 1.5


@pytest.mark.parametrize(
    ("kind", "raws"),
    [
        (NAMES, [Cdr().put("I", 1).text("a").put("I", 2).put("d", 1, 2).data]),
        (EMPTY, [b"\0\1\0\0\0", b"\0\1\0\0\0\0\0\0"]),
        (UNKNOWN, [b"anything", b""]),
    ],
    ids=["names", "empty", "unknown"],
)
def test_other_messages_are_kept_byte_for_byte(kind: RosType, raws: list[bytes]) -> None:
    assert again(kind, raws, {}) == ROS2_CODEC


def test_a_type_without_a_valid_definition_is_still_of_ros_2() -> None:
    assert (UNKNOWN.decoder, UNKNOWN.layout) == (None, "a_msgs/msg/U")
    assert "missing" in UNKNOWN.error or "invalid" in UNKNOWN.error
    assert view(Messages(UNKNOWN.id, UNKNOWN.layout, [b"x"])) == ({}, 0)
    assert dict(RosMessage(b"x", UNKNOWN)) == {}
    kind = MessageType("u", "/unknown", "a_msgs/msg/U", HASH, "this is no definition")
    assert message_type(kind.sample()) == kind
    assert (kind.id, kind.layout) == (UNKNOWN.id, UNKNOWN.layout)


@examples(100)
@given(st.data())
def test_any_messages_that_rosbags_serialized_are_restored(data: Any) -> None:
    definition = data.draw(definitions(ros2=True))
    messages = data.draw(st.lists(values(definition), min_size=1, max_size=4))
    kind = RosType("/made", definition.kind, HASH, text_of(definition))
    raws = [by_rosbags(definition, message, little_endian=data.draw(st.booleans())) for message in messages]
    again(kind, raws, {kind.id: kind.layout})
    columns = decode_batch(encode_batch(batch_of(kind, raws))).columns
    samples = [RosMessage(raw, kind) for raw in raws]
    for i, sample in enumerate(samples):
        finite = {name: value for name, value in sample.items() if _finite(value)}
        assert {name: column[i] for name, column in columns.items() if column[i] is not None} == finite


def _finite(value: Any) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


# What may follow the columns of a batch of two stamped messages.
REST = "00010000" + "00" * 5
ABOUT: list[Any] = [STAMPED.id, REST, "000000", "a"]


@pytest.mark.parametrize(
    "about",
    [
        [STAMPED.id],
        [STAMPED.id, REST],
        [STAMPED.id, REST, "000000"],
        [STAMPED.id, "0", "000000", "a"],
        [STAMPED.id, "xy", "000000", "a"],
        [STAMPED.id, 7, "000000", "a"],
        [STAMPED.id, [REST], "000000", "a"],
        [STAMPED.id, [REST, 7], "000000", "a"],
        [STAMPED.id, REST * 100_000, "000000", "a"],
        [STAMPED.id, REST[:-8], "000000", "a"],
        [STAMPED.id, REST + "00", "000000", "a"],
        [STAMPED.id, REST, "00x000", "a"],
        [STAMPED.id, REST, 7, "a"],
        [STAMPED.id, REST, [0, 2**80, 0], "a"],
        [STAMPED.id, REST, "000000", 7],
        [STAMPED.id, REST, "000000", "\ud800"],
        [STAMPED.id, REST, 1, "000000", "a"],
    ],
)
def test_an_invalid_description_of_messages_is_refused(about: list[Any]) -> None:
    columns = {"x": [1.5, 2.5], "n": [1, 2]}
    assert from_columns(columns, json.dumps(ABOUT), [T0, T0 + 1], LAYOUTS)
    with pytest.raises(ContractError):
        from_columns(columns, json.dumps(about), [T0, T0 + 1], LAYOUTS)


@given(st.lists(json_values | st.sampled_from(ABOUT), max_size=5))
def test_any_json_after_the_columns_gives_messages_or_is_refused(about: Any) -> None:
    try:
        messages = from_columns({"x": [1.5], "n": [1]}, json.dumps([STAMPED.id, *about]), [T0], LAYOUTS)
    except ContractError:
        return
    assert len(messages.raw) == 1


@examples(100)
@given(st.data())
def test_a_damaged_batch_of_messages_is_read_or_refused(data: Any) -> None:
    raws = [data.draw(st.sampled_from([stamped, lambda i: stamped(i, frame="x")]))(i) for i in range(3)]
    at = data.draw(st.integers(0, len(raws[1]) - 1))
    raws[1] = raws[1][:at] + data.draw(st.binary(max_size=3)) + raws[1][at + 1 :]
    again(STAMPED, raws)


# --- large arrays -----------------------------------------------------------------------------------


@given(
    st.binary(max_size=30),
    st.binary(min_size=1, max_size=40),
    st.floats(allow_nan=False),
    st.sampled_from("<>"),
)
def test_a_content_that_was_cut_out_is_restored(name: bytes, content: bytes, f: float, order: str) -> None:
    definition = parse("a_msgs/msg/A", "uint8[] name\nuint8[] data\nfloat64 f\nuint8[] more\nfloat64 g")
    raw = Cdr(order).put("I", len(name)).put("B", *name).put("I", len(content)).put("B", *content).put("d", f)
    whole = raw.put("I", len(content)).put("B", *content).put("d", f).data
    large = Decoder(definition, large=True).decode(whole)
    less, places = whole, []
    for field in ("name", "data", "more"):
        part = large[field]
        assert isinstance(part, Large)
        less, at = cut(less, part, len(whole) - len(less), ros2=True)
        places.append((part, at))
    # The rest is still decoded.
    assert Decoder(definition).decode(less) == {"f": f, "g": f}
    assert len(less) == len(whole) - sum(len(part) // 8 * 8 for part, _ in places)
    for part, at in reversed(places):
        less = filled(less, part, at, ros2=True)
    assert less == whole


@pytest.mark.parametrize("at", [-1, 1, 5, 100])
def test_a_content_is_restored_only_where_it_was(at: int) -> None:
    with pytest.raises(MessageError, match=f"no empty array at byte {at}"):
        filled(Cdr().put("I", 0).data, b"x" * 8, at, ros2=True)
    with pytest.raises(MessageError, match="no empty array"):
        filled(Cdr().put("I", 1).put("B", 5).data, b"x" * 9, 4, ros2=True)
