"""Messages of ROS 2 from and to JSON, strictly, as commands are written."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iort_agent.ros.json_message import Writer, decode, encode
from iort_contract.limits import MessageError
from iort_contract.ros.definition import parse
from tests.unit.contract.ros.ros2_messages import HEADER, LINE, Cdr
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, values

T0 = 1_700_000_000_000_000
MIXED = f"""bool b
int8 small
uint64 large
byte raw
float32 f
string<=5 s 'default'
wstring<=3 w
int16[2] two
float64[<=2] many
builtin_interfaces/Time t
Nothing nothing
Inner[] inner
{LINE}MSG: a_msgs/msg/Nothing
{LINE}MSG: a_msgs/msg/Inner
uint8[] raw
string<=2[] names
"""
GOOD = {
    "b": True, "small": -128, "large": 2**64 - 1, "raw": 255, "f": 1.5, "s": "grün", "w": "a\U0001f600",
    "two": [1, -2], "many": [1, 2.5], "t": {"sec": -1, "nanosec": 2}, "nothing": {},
    "inner": [{"raw": [1, 255], "names": ["a", ""]}],
}  # fmt: skip
STAMPED = f"std_msgs/Header header\nfloat64 x\nfloat64 y\n{HEADER}"


def test_json_becomes_little_endian_cdr_and_json_again() -> None:
    definition = parse("a_msgs/msg/A", MIXED)
    expected: dict[str, Cdr] = {}
    for order in "<>":
        cdr = Cdr(order).put("B", 1).put("b", -128).put("Q", 2**64 - 1).put("B", 255).put("f", 1.5)
        cdr.text("grün").wide("a\U0001f600").put("h", 1, -2).put("I", 2).put("d", 1, 2.5).put("i", -1)
        cdr.put("I", 2).put("B", 0).put("I", 1, 2).put("B", 1, 255).put("I", 2).text("a", "")
        expected[order] = cdr
        assert decode(definition, cdr.data) == GOOD
        assert decode(definition, cdr.data + bytes(-len(cdr.data) % 4)) == GOOD
    assert encode(definition, GOOD, now_us=T0) == expected["<"].data


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"raw": -1}, "raw: must be .* fits in char"),
        ({"s": "123456"}, "s: must have at most 5 bytes, got 6"),
        ({"s": "a\0b"}, "s: must be a text without NUL"),
        ({"w": "ab\U0001f600"}, "w: must have at most 3 bytes, got 4"),
        ({"w": "\ud800"}, "w: must be a text of Unicode"),
        ({"w": 1}, "w: must be a text, got 1"),
        ({"many": [1, 2, 3]}, "many: must have at most 2 elements, got 3"),
        ({"two": [1]}, "two: must have 2 elements, got 1"),
        ({"t": {"sec": 2**31, "nanosec": 0}}, r"t\.sec: must be .* fits in int32"),
        ({"t": {"sec": 0, "nanosec": 10**9}}, r"t\.nanosec: must be an integer from 0 to 9+"),
        ({"nothing": {"structure_needs_at_least_one_member": 0}}, "has no such field"),
        ({"nothing": 0}, "nothing: must be an object of no fields"),
        ({"inner": [{"raw": [], "names": ["abc"]}]}, r"inner\.0\.names\.0: must have at most 2 bytes"),
        ({"other": 1}, "other: a_msgs/A has no such field"),
    ],
)
def test_json_that_does_not_fit(change: dict[str, Any], error: str) -> None:
    definition = parse("a_msgs/msg/A", MIXED)
    with pytest.raises(MessageError, match=error):
        encode(definition, {**GOOD, **change}, now_us=T0)


def test_partial_means_zero_and_a_header_means_now() -> None:
    mixed, stamped = parse("a_msgs/msg/A", MIXED), parse("a_msgs/msg/S", STAMPED)
    zero = decode(mixed, encode(mixed, {"s": "x"}, now_us=T0, partial=True))
    assert zero == {
        "b": False, "small": 0, "large": 0, "raw": 0, "f": 0.0, "s": "x", "w": "", "two": [0, 0], "many": [],
        "t": {"sec": 0, "nanosec": 0}, "nothing": {}, "inner": [],
    }  # fmt: skip
    with pytest.raises(MessageError, match="many: is missing"):
        encode(mixed, {name: value for name, value in GOOD.items() if name != "many"}, now_us=T0)
    sent = decode(stamped, encode(stamped, {"x": 1, "y": 2}, now_us=T0 + 5))
    header = {"stamp": {"sec": T0 // 10**6, "nanosec": 5000}, "frame_id": ""}
    assert sent == {"header": header, "x": 1.0, "y": 2.0}
    given_header = {"stamp": {"secs": 2, "nsecs": 3}, "frame_id": "map"}
    found = decode(stamped, encode(stamped, {"header": given_header, "x": 1, "y": 2}, now_us=T0))
    assert found["header"] == {"stamp": {"sec": 2, "nanosec": 3}, "frame_id": "map"}
    # As ROS 1 writes it.
    with_seq = {"header": {"seq": 1, **given_header}, "x": 1, "y": 2}
    assert decode(stamped, encode(stamped, with_seq, now_us=T0)) == found


@settings(deadline=None)  # rosbags makes classes of each definition
@given(st.data())
def test_any_message_is_what_rosbags_writes(data: Any) -> None:
    definition = data.draw(definitions(ros2=True))
    message = data.draw(values(definition))
    raw = by_rosbags(definition, message)
    assert Writer(definition).write(message) == raw
    found = decode(definition, by_rosbags(definition, message, little_endian=False))
    assert repr(found) == repr(decode(definition, raw))
    if _finite(message):
        assert encode(definition, found, now_us=T0) == raw


def _finite(value: Any) -> bool:
    if isinstance(value, (dict, list)):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


@given(st.binary(max_size=120), st.sampled_from([b"\0\1\0\0", b"\0\0\0\0", b""]))
def test_any_bytes_are_a_message_or_refused(data: bytes, start: bytes) -> None:
    with suppress(MessageError):
        decode(parse("a_msgs/msg/A", MIXED), start + data)
