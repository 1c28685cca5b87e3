"""ROS 1 messages from their bytes, by the definition that comes with them; no ROS is needed.

rosbags, which is independent of it, serialises the messages and says what must come out.
"""

from __future__ import annotations

import itertools
import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import MAX_FIELDS, MessageError
from iort_contract.ros import decode
from iort_contract.ros.decode import MAX_TEXT, Decoder, stamp_ns
from iort_contract.ros.definition import VARIABLE, parse
from iort_contract.ros.plan import MAX_ELEMENTS
from tests.examples import examples
from tests.flatten import flatten
from tests.recordings import recording
from tests.unit.contract.ros.ros1_messages import HEADER, LINE, STAMPED, header, nested, text, u32
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, values, view_of


def nested_header(path: str) -> dict[str, Any]:
    """The view of a nested `header()`."""
    return {f"{path}.seq": 1, f"{path}.stamp.sec": 5, f"{path}.stamp.nanosec": 7000,
            f"{path}.frame_id": "base_link"}  # fmt: skip


def decoded(definition: str, data: bytes, **how: Any) -> dict[str, Any]:
    return Decoder(parse("a_msgs/A", definition), **how).decode(data)


@pytest.mark.parametrize(
    ("definition", "data", "values"),
    [
        ("float64 data", struct.pack("<d", 1.5), {"data": 1.5}),
        ("bool a\nbyte b\nchar c\nint8 d\nuint8 e", b"\x02\xff\xff\x80\x80",
         {"a": True, "b": -1, "c": 255, "d": -128, "e": 128}),
        ("int16 a\nuint16 b\nint32 c\nuint32 d\nint64 e\nuint64 f",
         struct.pack("<hHiIqQ", -1, 2, -3, 4, -5, 2**64 - 1),
         {"a": -1, "b": 2, "c": -3, "d": 4, "e": -5, "f": 2**64 - 1}),
        ("time t\nduration d", struct.pack("<IIii", 1, 2, -3, 4),
         {"t.sec": 1, "t.nanosec": 2, "d.sec": -3, "d.nanosec": 4}),
        ("string s\nuint8 n", text("grün") + b"\x01", {"s": "grün", "n": 1}),
        ("string s", u32(2) + b"\xff\xfe", {"s": "\ufffd\ufffd"}),
        ("uint8[3] a\nint16[] b\nuint8 c", b"\x01\x02\x03" + u32(2) + struct.pack("<hh", 4, -5) + b"\x06",
         {"a.0": 1, "a.1": 2, "a.2": 3, "b.0": 4, "b.1": -5, "c": 6}),
        ("string[] s\nstring[2] t", u32(1) + text("a") + text("b") + text(""),
         {"s.0": "a", "t.0": "b", "t.1": ""}),
        ("B[] b\nuint8 c\n" + "=" * 80 + "\nMSG: a_msgs/B\nstring s\nuint8[2] u",
         u32(2) + text("x") + b"\x01\x02" + text("yy") + b"\x03\x04" + b"\x05",
         {"b.0.s": "x", "b.0.u.0": 1, "b.0.u.1": 2, "b.1.s": "yy", "b.1.u.0": 3, "b.1.u.1": 4, "c": 5}),
        ("B[2] b\nuint8 c\n" + "=" * 80 + "\nMSG: a_msgs/B\nuint8 u", b"\x01\x02\x03",
         {"b.0.u": 1, "b.1.u": 2, "c": 3}),
        ("Header header\nuint8 a" + HEADER, header() + b"\x01", {"a": 1}),
        ("Header header\na_msgs/B b" + HEADER + "=" * 80 + "\nMSG: a_msgs/B\nHeader header\nuint8 u\nuint8 v",
         header() + header() + b"\x01\x02", {**nested_header("header"), "u": 1, "v": 2}),
        ("uint8 a\nHeader header" + HEADER, b"\x01" + header(), {"a": 1, **nested_header("header")}),
        ("Header header\nHeader other\nuint8 a" + HEADER, header() + header() + b"\x01",
         {**nested_header("other"), "a": 1}),
        ("Header[] header\nuint8 a" + HEADER, u32(1) + header() + b"\x01",
         {**nested_header("header.0"), "a": 1}),
        ("float32 header\nuint8 a", struct.pack("<fB", 0.5, 1), {"header": 0.5, "a": 1}),
        ("B header\n" + "=" * 80 + "\nMSG: a_msgs/B\nuint8 u", b"\x01", {"header.u": 1}),
        ("Header header" + HEADER, header(), {}),
        ("Header header\ntime t" + HEADER, header() + u32(3, 4), {"sec": 3, "nanosec": 4}),
        ("uint8 X=1 # one\nstring S=a # is = part of it\nfloat32 PI = 3\nuint8 y # = 5", b"\x09", {"y": 9}),
        ("B b\n" + "=" * 80 + "\nMSG: a_msgs/B\nuint8 NOTHING=0", b"", {}),
        ("B[] b\n" + "=" * 80 + "\nMSG: a_msgs/B\n", u32(2**32 - 1), {}),
        ("", b"", {}),
    ],
)  # fmt: skip
def test_a_message_decodes_to_flat_fields(definition: str, data: bytes, values: dict[str, Any]) -> None:
    found = decoded(definition, data)
    assert found == values
    assert [type(v) for v in found.values()] == [type(v) for v in values.values()]


def test_the_stamp_is_exact_to_the_nanosecond() -> None:
    decoder = Decoder(parse("a_msgs/A", STAMPED + "uint8 u"))
    data = header(1_700_000_000, 999_999_999) + b"\x01"
    assert (decoder.stamped, decoder.decode(data)) == (True, {"u": 1})
    assert stamp_ns(data) == 1_700_000_000_999_999_999
    assert stamp_ns(data[:15]) is None
    assert not Decoder(parse("a_msgs/A", "uint8 u")).stamped


SELECTABLE = (
    "float64 speed\nstring name\nB b\nB[2] two\nB[] many\nuint8[100] large\nfloat32[] ranges\nuint8 last\n"
    + "=" * 80
    + "\nMSG: a_msgs/B\nint16 x\nstring y\nint16 z"
)


def b_bytes(x: int) -> bytes:
    return struct.pack("<h", x) + text(f"y{x}") + struct.pack("<h", -x)


SELECT_DATA = (
    struct.pack("<d", 2.5) + text("n") + b_bytes(1) + b_bytes(2) + b_bytes(3) + u32(3) + b_bytes(4)
    + b_bytes(5) + b_bytes(6) + bytes(range(100)) + u32(200) + struct.pack("<200f", *range(200)) + b"\x07"
)  # fmt: skip


@pytest.mark.parametrize(
    ("select", "values", "unknown"),
    [
        (["speed"], {"speed": 2.5}, []),
        (["last"], {"last": 7}, []),
        (["b", "name"], {"name": "n", "b.x": 1, "b.y": "y1", "b.z": -1}, []),
        (["b.z", "two.1.x"], {"b.z": -1, "two.1.x": 3}, []),
        (["many.1.y"], {"many.1.y": "y5"}, []),
        (["many.9.y"], {}, []),
        (["many"], {f"many.{i}.{k}": v for i, n in enumerate((4, 5, 6))
                    for k, v in (("x", n), ("y", f"y{n}"), ("z", -n))}, []),
        (["large.99", "ranges.150"], {"large.99": 99, "ranges.150": 150.0}, []),
        (["sped", "speed", "two.2.x", "b.w"], {"speed": 2.5}, ["b.w", "sped", "two.2.x"]),
    ],
)  # fmt: skip
def test_only_selected_fields_are_decoded(
    select: list[str], values: dict[str, Any], unknown: list[str]
) -> None:
    decoder = Decoder(parse("a_msgs/A", SELECTABLE), select=select)
    assert decoder.decode(SELECT_DATA) == values
    assert decoder.unknown == unknown
    assert not decoder.left_out


def test_fields_without_telemetry_are_left_out_and_counted() -> None:
    definition = "uint8[] image\nfloat32[] ranges\nfloat64[100] grid\nstring s\nuint8 last"
    data = u32(3) + b"abc" + u32(65) + bytes(65 * 4) + bytes(800) + text("x" * (MAX_TEXT + 1)) + b"\x01"
    decoder = Decoder(parse("a_msgs/A", definition))
    for _ in range(2):
        assert decoder.decode(data) == {"last": 1}
    assert decoder.left_out == {"image": 2, "ranges": 2, "grid": 2, "s": 2}
    small = u32(0) + u32(MAX_ELEMENTS) + bytes(MAX_ELEMENTS * 4) + bytes(800) + text("") + b"\x01"
    assert len(decoder.decode(small)) == MAX_ELEMENTS + 2


BEYOND = "(fields beyond 512)"


@pytest.mark.parametrize(
    ("definition", "size", "first"),
    [
        ("".join(f"float64[60] f{i}\n" for i in range(10)), 4800, ["f0.0", "f0.1"]),
        ("B[64] b\n" + LINE + "MSG: a_msgs/B\nC[64] c\n" + LINE + "MSG: a_msgs/C\nuint8[64] u\nuint8 v",
         64 * 64 * 65, ["b.0.c.0.u.0", "b.0.c.0.u.1"]),
        ("B[64] b\n" + LINE + "MSG: a_msgs/B\nfloat64[64] u", 64 * 64 * 8, ["b.0.u.0", "b.0.u.1"]),
        ("uint8 a\nB[] b\n" + LINE + "MSG: a_msgs/B\nuint8[64] u", None, ["a", "b.0.u.0"]),
        ("uint8 a\nB[] b\n" + LINE + "MSG: a_msgs/B\nC[] c\n" + LINE + "MSG: a_msgs/C\nuint8[64] u", None,
         ["a", "b.0.c.0.u.0"]),
    ],
)  # fmt: skip
def test_fields_beyond_512_are_cut_from_the_view_and_counted(
    definition: str, size: int | None, first: list[str]
) -> None:
    decoder = Decoder(parse("a_msgs/A", definition))
    within = b"\1" + (u32(20) + bytes(20 * 64)) if "c\n" not in definition else b""
    data = bytes(size) if size is not None else within or b"\1" + u32(4) + 4 * (u32(9) + bytes(9 * 64))
    for times in (1, 2):
        values = decoder.decode(data)
        assert (len(values), list(values)[:2]) == (512, first)
        assert decoder.left_out == {BEYOND: times}
    assert decoder.flat is None


@pytest.mark.parametrize("length", ["", "[64]", "[16777216]"])
@pytest.mark.parametrize("leaf", ["uint8 u", "string s", "string[0] s", "uint8[] u"])
def test_nested_types_give_a_bounded_view(length: str, leaf: str) -> None:
    """A definition of a few lines can describe more fields than anyone can visit."""
    definition = nested(length, leaf)
    for select in (None, ["a0.x"]):
        try:
            Decoder(parse("a_msgs/A", definition), select=select).decode(bytes(1000))
        except MessageError:
            continue
        # Only an empty message has the length of this definition.
        raise AssertionError("1000 bytes are no such message")


@pytest.mark.parametrize(("n", "fields"), [(40, 512), (0, 0)], ids=["full", "empty"])
def test_nested_arrays_give_a_bounded_view(n: int, fields: int) -> None:
    """A message of megabytes may hold millions of values, or tens of thousands of empty arrays."""
    kinds = ["T0", "T1", "T2"]
    definition = "T0[] a\n"
    for kind, inner in zip(kinds, [*kinds[1:], "int8"]):
        definition += f"{LINE}MSG: a_msgs/{kind}\n{inner}[] a\n"
    data = u32(n) + bytes(n)
    for _ in kinds:
        data = u32(40) + data * 40
    decoder = Decoder(parse("a_msgs/A", definition))
    named_before = decode._element_names.cache_info().misses
    tracemalloc.start()
    try:
        assert len(decoder.decode(data)) == fields
        assert decode._element_names.cache_info().misses - named_before <= MAX_FIELDS + 1
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("definition", "data", "error"),
    [
        ("float64 a", bytes(7), "7 bytes is truncated"),
        ("float64 a", bytes(9), "must have 8 bytes, got 9"),
        ("string s", u32(5) + b"abc", "must have 9 bytes, got 7"),
        ("string s", b"\x01", "truncated"),
        ("float64[] a", u32(2**32 - 1), "truncated"),
        ("uint8[] a", u32(2**32 - 1), "truncated"),
        ("string[] a", u32(20_000), "truncated"),
        ("string[] a", u32(2**32 - 1), "too many elements to decode: 4294967295"),
        ("string[1000] a", b"", "truncated"),
        ("string[1000000] a", b"", "too many elements to decode: 1000000"),
    ],
)
def test_bytes_that_do_not_fit_the_definition_are_refused(definition: str, data: bytes, error: str) -> None:
    with pytest.raises(MessageError, match=error):
        decoded(definition, data)
    with pytest.raises(MessageError):
        decoded(definition, data, select=["nothing"])


@pytest.mark.parametrize(
    ("definition", "error"),
    [
        ("float64", "invalid line 'float64'"),
        ("float64 a b", "invalid line"),
        ("flo at64 a[3]", "invalid line"),
        ("Unknown a", "the definition of a_msgs/Unknown is missing"),
        ("A a", "contains itself"),
        ("B b\n" + "=" * 80 + "\nMSG: a_msgs/B\nA a", "contains itself"),
        ("B b\n" + "=" * 80 + "\nuint8 a", "must begin with MSG"),
        ("uint8[99999999999] a", "99999999999 elements"),
    ],
)
def test_an_invalid_definition_is_refused(definition: str, error: str) -> None:
    with pytest.raises(MessageError, match=error):
        parse("a_msgs/A", definition)


def test_fields_and_lengths_follow_from_the_definition() -> None:
    fields = parse("a_msgs/A", "uint8[] a\nuint8[3] b\nuint8 c\nHeader h\n" + HEADER).fields()
    assert [f.length for f in fields] == [VARIABLE, 3, None, None]
    assert fields[3].kind == "std_msgs/Header"


def test_a_real_recording_decodes_as_rosbags_decodes_it() -> None:
    from rosbags.highlevel import AnyReader

    with AnyReader([recording("f1tenth-motor-servo.bag")]) as reader:
        # The newest rosbags for Python 3.8 has the older name.
        fields = getattr(reader.typestore, "fielddefs", None) or reader.typestore.FIELDDEFS

        def members(value: Any) -> dict[str, Any] | None:
            known = fields.get(getattr(value, "__msgtype__", ""))
            return None if known is None else {name: getattr(value, name) for name, _ in known[1]}

        counts: dict[str, int] = {}
        for connection in reader.connections:
            kind = connection.msgtype.replace("/msg/", "/")
            # In the newest rosbags for Python 3.8 it is the text itself.
            definition = getattr(connection.msgdef, "data", connection.msgdef)
            decoder = Decoder(parse(kind, definition))
            for _, _, raw in reader.readers[0].messages([connection]):
                message = reader.deserialize(raw, connection.msgtype)
                values = decoder.decode(raw)
                assert values == flatten(message, members)
                if decoder.stamped:
                    stamp = message.header.stamp
                    assert stamp_ns(raw) == stamp.sec * 1_000_000_000 + stamp.nanosec
                counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts == {"/sensors/core": 2244, "/sensors/servo_position_command": 879}


# Random definitions, and messages of them, serialised by rosbags.


@examples(150)
@given(st.data())
def test_any_message_decodes_to_the_values_that_rosbags_serialized(data: Any) -> None:
    definition = data.draw(definitions())
    message = data.draw(values(definition))
    raw = by_rosbags(definition, message)
    expected = dict(itertools.islice(view_of(definition, message), MAX_FIELDS))
    # NaN equals itself by its text alone.
    assert repr(Decoder(definition).decode(raw)) == repr(expected)
    for name in list(expected)[:3]:
        assert repr(Decoder(definition, select=[name]).decode(raw)) == repr({name: expected[name]})


@given(st.binary(max_size=60), st.sampled_from([None, ["b.1.x"]]))
def test_garbage_raises_only_a_message_error(data: bytes, select: list[str] | None) -> None:
    try:
        decoded(SELECTABLE, data, select=select)
    except MessageError:
        return
