"""Messages of ROS 2 decode to the fields that ROS 1's would have, whatever their gaps and byte order are."""

from __future__ import annotations

import itertools
import tracemalloc
from contextlib import suppress
from typing import Any, Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.limits import MAX_FIELDS, MessageError
from iort_contract.ros.decode import Decoder, stamp_ns
from iort_contract.ros.definition import VARIABLE, Field, layout, parse, short_kind
from iort_contract.ros.plan import MAX_ELEMENTS, SIZES
from tests.examples import examples
from tests.unit.contract.ros.ros1_messages import nested
from tests.unit.contract.ros.ros2_messages import HEADER, LINE, STAMPED, Cdr
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, values, view_of

B = f"\n{LINE}MSG: a_msgs/msg/B\n"
ORDERS = pytest.mark.parametrize("order", ["<", ">"], ids=["little", "big"])


def decoded(definition: str, data: bytes, **how: Any) -> dict[str, Any]:
    return Decoder(parse("a_msgs/msg/A", definition), **how).decode(data)


CASES: list[tuple[str, Callable[[Cdr], Cdr], dict[str, Any]]] = [
    ("uint8 a\nfloat64 b\nuint8 c\nint16 d\nuint8 e\nfloat32 f",
     lambda cdr: cdr.put("B", 1).put("d", 2.5).put("B", 3).put("h", -4).put("B", 5).put("f", 6),
     {"a": 1, "b": 2.5, "c": 3, "d": -4, "e": 5, "f": 6.0}),
    ("bool a\nbyte b\nchar c\nint8 d", lambda cdr: cdr.put("B", 2, 255, 255).put("b", -1),
     {"a": True, "b": 255, "c": 255, "d": -1}),
    ("uint8 a\nuint64 b\nint64 c", lambda cdr: cdr.put("B", 1).put("Q", 2**64 - 1).put("q", -(2**63)),
     {"a": 1, "b": 2**64 - 1, "c": -(2**63)}),
    ("builtin_interfaces/Time t\nbuiltin_interfaces/msg/Duration d",
     lambda cdr: cdr.put("i", -1).put("I", 2**32 - 1).put("i", -3).put("I", 4),
     {"t.sec": -1, "t.nanosec": 2**32 - 1, "d.sec": -3, "d.nanosec": 4}),
    ("string s\nuint8 n\nstring<=9 t", lambda cdr: cdr.text("grün").put("B", 1).text(""),
     {"s": "grün", "n": 1, "t": ""}),
    ("wstring s\nuint8 n\nwstring<=3[] t\nfloat64 f",
     lambda cdr: cdr.wide("aß\U0001f600").put("B", 1).put("I", 1).wide("").put("d", 2),
     {"s": "aß\U0001f600", "n": 1, "t.0": "", "f": 2.0}),
    ("uint8 a\nfloat64[] none\nuint8 b\nfloat64[<=3] few\nuint8 c",
     lambda cdr: cdr.put("B", 1).put("I", 0).put("B", 2).put("I", 2).put("d", 3, 4).put("B", 5),
     {"a": 1, "b": 2, "few.0": 3.0, "few.1": 4.0, "c": 5}),
    ("uint8[3] a\nfloat64[2] b\nbool[] c",
     lambda cdr: cdr.put("B", 1, 2, 3).put("d", 4, 5).put("I", 1).put("B", 1),
     {"a.0": 1, "a.1": 2, "a.2": 3, "b.0": 4.0, "b.1": 5.0, "c.0": True}),
    (f"B[] b\nuint8 c{B}uint8 x\nfloat64 y",
     lambda cdr: cdr.put("I", 2).put("B", 1).put("d", 2).put("B", 3).put("d", 4).put("B", 5),
     {"b.0.x": 1, "b.0.y": 2.0, "b.1.x": 3, "b.1.y": 4.0, "c": 5}),
    (f"uint8 a\na_msgs/msg/B[2] b{B}float64 x\nuint8 y",
     lambda cdr: cdr.put("B", 1).put("d", 2).put("B", 3).put("d", 4).put("B", 5),
     {"a": 1, "b.0.x": 2.0, "b.0.y": 3, "b.1.x": 4.0, "b.1.y": 5}),
    (f"B[<=2] b\nint32 c{B}string s\nuint16 u",
     lambda cdr: cdr.put("I", 2).text("x").put("H", 1).text("yy").put("H", 2).put("i", 3),
     {"b.0.s": "x", "b.0.u": 1, "b.1.s": "yy", "b.1.u": 2, "c": 3}),
    ("uint8 X=1\nstring S='a # b'\nfloat32 PI = 3.1\nuint8 y 5\nstring s \"a=b\"\nint32[] z [1, 2]",
     lambda cdr: cdr.put("B", 9).text("q").put("I", 0), {"y": 9, "s": "q"}),
    ("", lambda cdr: cdr.put("B", 0), {}),
    ("uint8 structure_needs_at_least_one_member", lambda cdr: cdr.put("B", 7), {}),
    (f"B b\nuint16 c\nB[2] d\nB[] e\nuint8 f{B}uint8 NOTHING=0",
     lambda cdr: cdr.put("B", 0).put("H", 1).put("B", 0, 0).put("I", 3).put("B", 0, 0, 0, 2),
     {"c": 1, "f": 2}),
    (f"std_msgs/Header header\nuint8 a{HEADER}", lambda cdr: cdr.header().put("B", 1), {"a": 1}),
    (f"std_msgs/msg/Header header\na_msgs/B b{HEADER}{B}uint8 u\nfloat64 v",
     lambda cdr: cdr.header(frame="x").put("B", 1).put("d", 2), {"u": 1, "v": 2.0}),
    (STAMPED, lambda cdr: cdr.header().put("B", 0), {}),
    (f"std_msgs/Header header{HEADER}", lambda cdr: cdr.header(), {}),
    (f"uint8 a\nstd_msgs/Header header{HEADER}", lambda cdr: cdr.put("B", 1).header(),
     {"a": 1, "header.stamp.sec": 5, "header.stamp.nanosec": 7000, "header.frame_id": "base_link"}),
]  # fmt: skip


@ORDERS
@pytest.mark.parametrize(("definition", "write", "expected"), CASES)
def test_a_message_decodes_to_flat_fields(
    order: str, definition: str, write: Callable[[Cdr], Cdr], expected: dict[str, Any]
) -> None:
    data = write(Cdr(order)).data
    # The layout in a batch is sufficient, too.
    for text in (definition, layout(parse("a_msgs/msg/A", definition))):
        found = decoded(text, data)
        assert found == expected
        assert [type(value) for value in found.values()] == [type(value) for value in expected.values()]


@ORDERS
def test_the_stamp_is_exact_and_may_be_before_1970(order: str) -> None:
    data = Cdr(order).header(1_700_000_000, 999_999_999).put("B", 1).data
    assert Decoder(parse("a_msgs/msg/A", STAMPED + "uint8 u")).stamped
    assert stamp_ns(data, ros2=True) == 1_700_000_000_999_999_999
    assert stamp_ns(Cdr(order).header(-1, 5).data, ros2=True) == -999_999_995
    assert stamp_ns(data[:15], ros2=True) is None
    assert stamp_ns(b"\0\3" + data[2:], ros2=True) is None


def test_a_definition_is_parsed_with_its_bounds_under_short_names() -> None:
    text = f"string<=10[<=5] a\nwstring<=3 b\nstring[<=2] c\nB[4] d\nbyte e{B}builtin_interfaces/Time t\n"
    definition = parse("a_msgs/msg/A", text)
    assert (definition.kind, definition.ros2) == ("a_msgs/msg/A", True)
    assert definition.fields() == (
        Field("a", "string", VARIABLE, 5, 10),
        Field("b", "wstring", None, None, 3),
        Field("c", "string", VARIABLE, 2),
        Field("d", "a_msgs/B", 4),
        Field("e", "char", None),
    )
    assert definition.fields("a_msgs/B") == (Field("t", "time", None),)
    assert parse("a_msgs/msg/A", layout(definition)) == definition
    assert not parse("a_msgs/A", "uint8 a").ros2
    assert [short_kind(kind) for kind in ("a/B", "a/msg/B", "a/srv/B_Request")] == [
        "a/B",
        "a/B",
        "a/B_Request",
    ]


def test_a_header_without_its_package_is_of_the_same_package_if_that_has_one() -> None:
    own = parse("a_msgs/msg/A", f"Header h\n{LINE}MSG: a_msgs/Header\nuint8 x\n")
    assert own.fields()[0].kind == "a_msgs/Header"
    assert Decoder(own).decode(b"\0\1\0\0\7") == {"h.x": 7}
    assert parse("a_msgs/msg/A", f"Header header{HEADER}").stamped()


def test_times_may_be_defined_in_the_text_or_not() -> None:
    times = f"{LINE}MSG: builtin_interfaces/msg/Time\nint32 sec\nuint32 nanosec\n"
    for own in ("", times):
        found = decoded(f"builtin_interfaces/Time t{HEADER}{own}", Cdr().put("i", 1).put("I", 2).data)
        assert found == {"t.sec": 1, "t.nanosec": 2}
    clock = Decoder(parse("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec"))
    assert clock.decode(Cdr().put("i", 1).put("I", 2).data) == {"sec": 1, "nanosec": 2}


@pytest.mark.parametrize(
    ("definition", "error"),
    [
        ("float64", "invalid line 'float64'"),
        ("flo at64 a[3]", "the definition of a_msgs/flo is missing"),
        ("float64[ 3] a", "invalid line"),
        ("float64<=3 a", "invalid line"),
        ("float64[<=] a", "invalid line"),
        ("Unknown a", "the definition of a_msgs/Unknown is missing"),
        ("b_msgs/msg/Unknown a", "the definition of b_msgs/Unknown is missing"),
        ("A a", "contains itself"),
        ("B b\n" + "=" * 80 + "\nIDL: a_msgs/msg/B\nmodule a_msgs {};", "must begin with MSG"),
        ("uint8[99999999999] a", "99999999999 elements"),
        (f"uint8[{'9' * 5000}] a", "invalid line"),
        (f"uint8[<={'9' * 5000}] a", "invalid line"),
    ],
)
def test_an_invalid_definition_is_refused(definition: str, error: str) -> None:
    with pytest.raises(MessageError, match=error):
        parse("a_msgs/msg/A", definition)


@ORDERS
@pytest.mark.parametrize(
    ("definition", "write", "error"),
    [
        ("float64 a", lambda cdr: cdr.put("f", 1), "12 bytes|8 bytes is truncated"),
        ("float64 a", lambda cdr: cdr.put("d", 1).put("B", 0), "must have 12 bytes, got 13"),
        ("float64 a", lambda cdr: cdr.put("d", 1).put("I", 0), "must have 12 bytes, got 16"),
        ("uint8 a", lambda cdr: cdr.put("B", 1, 0, 0), "must have 5 bytes, got 7"),
        ("string s", lambda cdr: cdr.put("I", 2).put("B", 65, 66), "must end with a NUL"),
        ("string s", lambda cdr: cdr.put("I", 9).put("B", 65, 0), "must have 17 bytes, got 10"),
        ("wstring s", lambda cdr: cdr.put("I", 1, 65536), "must be below 65536"),
        ("wstring s", lambda cdr: cdr.put("I", 2, 65), "must have 16 bytes, got 12"),
        ("float64[] a", lambda cdr: cdr.put("I", 2**32 - 1), "truncated"),
        ("B[] a" + B + "uint8 x\nfloat64 y", lambda cdr: cdr.put("I", 2**32 - 1), "truncated"),
        ("string[] a", lambda cdr: cdr.put("I", 2**32 - 1), "too many elements to decode: 4294967295"),
    ],
)
def test_bytes_that_do_not_fit_the_definition_are_refused(
    order: str, definition: str, write: Callable[[Cdr], Cdr], error: str
) -> None:
    data = write(Cdr(order)).data
    for select in (None, ["nothing"]):
        if select and "NUL" in error + definition:
            continue
        with pytest.raises(MessageError, match=error if select is None else None):
            decoded(definition, data, select=select)


@ORDERS
def test_what_fast_dds_reserved_for_nothing_may_follow(order: str) -> None:
    """As its serialize_message gives a JointState without positions, and a text of a wstring."""
    for definition, data, most in (
        (
            "string[] name\nfloat64[] a\nfloat64[] b\nuint8 c",
            Cdr(order).put("I", 0, 0, 0).put("B", 1).data,
            19,
        ),
        ("wstring s", Cdr(order).wide("ab").data, 11),
        ("float64[] a\nuint8[] b\nint64[] c", Cdr(order).put("I", 1).put("d", 1).put("I", 0, 0).data, 11),
    ):
        expected = decoded(definition, data)
        for more in range(1, most + 1):
            assert decoded(definition, data + b"x" * more) == expected
        with pytest.raises(MessageError, match=f"must have {len(data)} bytes, got {len(data) + most + 1}"):
            decoded(definition, data + b"x" * (most + 1))


@pytest.mark.parametrize(
    "start", ["", "00", "0001", "000100", "0002", "0003", "0006", "0007", "0100", "0a00"]
)
def test_only_plain_cdr_is_decoded(start: str) -> None:
    with pytest.raises(MessageError):
        decoded("uint32 a", bytes.fromhex(start) + (bytes(6) if len(start) == 4 and start != "0001" else b""))


SELECTABLE = (
    "float64 speed\nstring name\nB b\nB[2] two\nB[] many\nuint8[100] large\nfloat64[] ranges\nC[] fixed\n"
    f"uint8 last{B}int16 x\nstring y\nint16 z\n{LINE}MSG: a_msgs/C\nuint8 k\nfloat64 v\nuint8[3] w"
)


def _select_data(order: str) -> bytes:
    cdr = Cdr(order).put("d", 2.5).text("n")

    def put_b(x: int) -> None:
        cdr.put("h", x).text(f"y{x}").put("h", -x)

    for x in (1, 2, 3):
        put_b(x)
    cdr.put("I", 2)
    for x in (4, 5):
        put_b(x)
    cdr.put("B", *range(100)).put("I", 200).put("d", *range(200)).put("I", 99)
    for x in range(99):
        cdr.put("B", x).put("d", x / 2).put("B", 7, 8, 9)
    return cdr.put("B", 7).data


@ORDERS
@pytest.mark.parametrize(
    ("select", "expected"),
    [
        (["speed"], {"speed": 2.5}),
        (["last"], {"last": 7}),
        (["b.z", "two.1.x"], {"b.z": -1, "two.1.x": 3}),
        (["many.1.y"], {"many.1.y": "y5"}),
        (["large.99", "ranges.150"], {"large.99": 99, "ranges.150": 150.0}),
        (
            ["fixed.0.v", "fixed.97.v", "fixed.98.w.2"],
            {"fixed.0.v": 0.0, "fixed.97.v": 48.5, "fixed.98.w.2": 9},
        ),
    ],
)
def test_only_selected_fields_are_decoded(order: str, select: list[str], expected: dict[str, Any]) -> None:
    decoder = Decoder(parse("a_msgs/msg/A", SELECTABLE), select=select)
    assert decoder.decode(_select_data(order)) == expected
    assert not decoder.unknown


@ORDERS
def test_large_arrays_are_taken_with_their_places(order: str) -> None:
    data = Cdr(order).put("B", 1).put("I", 70).put("B", *range(70)).put("d", 1).data
    decoder = Decoder(parse("a_msgs/msg/A", "uint8 a\nuint8[] image\nfloat64 b"), large=True)
    found = decoder.decode(data)
    assert (found.pop("image"), found) == (bytes(range(70)), {"a": 1, "b": 1.0})
    plain = Decoder(parse("a_msgs/msg/A", "uint8 a\nuint8[] image\nfloat64[] many"))
    many = Cdr(order).put("B", 1).put("I", 1).put("B", 1).put("I", MAX_ELEMENTS + 1)
    for times in (1, 2):
        assert plain.decode(many.put("d", *[0.0] * (MAX_ELEMENTS + 1) * (times == 1)).data) == {"a": 1}
        assert plain.left_out == {"image": times, "many": times}


@ORDERS
@pytest.mark.parametrize("length", ["", "[64]", "[16777216]"])
@pytest.mark.parametrize("leaf", ["uint8 u", "string s", "string[0] s", "uint8[] u", ""])
def test_nested_types_give_a_bounded_view(length: str, leaf: str, order: str) -> None:
    definition = nested(length, leaf)
    for select in (None, ["a0.x"]):
        # Only an empty message has the length of this definition.
        with pytest.raises(MessageError):
            Decoder(parse("a_msgs/msg/A", definition), select=select).decode(Cdr(order).data + bytes(1000))


def test_many_empty_messages_give_a_bounded_plan() -> None:
    """A definition of a few lines can describe any number of bytes."""
    empties = "".join(f"E e{i}\n" for i in range(500))
    definition = f"T[64] t\n{LINE}MSG: a_msgs/T\nint8 x\n{empties}{LINE}MSG: a_msgs/E\n"
    tracemalloc.start()
    try:
        decoder = Decoder(parse("a_msgs/msg/A", definition))
        assert decoder.decode(Cdr().data + bytes(64 * 501)) == {f"t.{i}.x": 0 for i in range(64)}
        assert decoder.flat is None
        deep = "".join(f"T{i}[64] t\n{LINE}MSG: a_msgs/T{i}\n" for i in range(6))
        with pytest.raises(MessageError, match="too large"):
            Decoder(parse("a_msgs/msg/A", f"uint8 a\n{deep}"))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


@examples(150)
@given(st.data())
def test_any_message_decodes_to_the_values_that_rosbags_serialized(data: Any) -> None:
    definition = data.draw(definitions(ros2=True))
    message = data.draw(values(definition))
    expected = dict(itertools.islice(view_of(definition, message), MAX_FIELDS))
    decoder = Decoder(definition)
    for little_endian in (True, False):
        raw = by_rosbags(definition, message, little_endian=little_endian)
        # NaN equals itself by its text alone.
        assert repr(decoder.decode(raw)) == repr(expected)
        assert repr(decoder.decode(raw + b"\xff" * (-len(raw) % 4))) == repr(expected)
        for name in list(expected)[:3]:
            assert repr(Decoder(definition, select=[name]).decode(raw)) == repr({name: expected[name]})


@examples(60)
@given(st.data())
def test_a_truncated_or_longer_message_is_refused(data: Any) -> None:
    definition = data.draw(definitions(ros2=True))
    raw = by_rosbags(definition, data.draw(values(definition)), little_endian=data.draw(st.booleans()))
    decoder = Decoder(definition)
    for end in range(len(raw)):
        with pytest.raises(MessageError):
            decoder.decode(raw[:end])
    # An empty array of numbers of 8 bytes lets bytes be behind the fields.
    fields = [field for fields in definition.types.values() for field in fields]
    least = 9 * len(raw) if any(map(may_be_loose, fields)) else 1
    for more in range(least, least + 8):
        if (len(raw) + more) % 4 or more > 3:
            with pytest.raises(MessageError):
                decoder.decode(raw + bytes(more))


def may_be_loose(field: Field) -> bool:
    return field.length == VARIABLE and SIZES.get(field.kind) == 8


@examples(150)
@given(st.data())
def test_garbage_raises_only_a_message_error(data: Any) -> None:
    definition = data.draw(definitions(ros2=True))
    start = data.draw(st.sampled_from([b"\0\1\0\0", b"\0\0\0\0", b""]))
    raw = start + data.draw(st.binary(max_size=200))
    for select in (None, ["f0", "f1.f2.3"]):
        for large in (False, True):
            with suppress(MessageError):
                Decoder(definition, select=select, large=large).decode(raw)
