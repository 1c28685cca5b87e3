"""JSON to a ROS 1 message and back."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.ros1.json_message import decode, encode
from iort_contract.limits import MessageError
from iort_contract.ros1.definition import parse
from tests.unit.agent.control.downlink_rig import POSE, POSE_MESSAGE, RULE, T0

MIXED = f"""bool b
int8 small
uint64 large
float32 f
string s
int16[2] two
float64[] many
time t
duration ago
Inner[] inner
{RULE}
MSG: a_msgs/Inner
uint8[] raw
string[2] names
"""
GOOD = {
    "b": True, "small": -128, "large": 2**64 - 1, "f": 1.5, "s": "grün", "two": [1, -2], "many": [1, 2.5],
    "t": {"sec": 1, "nanosec": 2}, "ago": {"sec": -1, "nanosec": 999_999_999},
    "inner": [{"raw": [1, 255], "names": ["a", ""]}],
}  # fmt: skip


def test_json_to_ros_and_back() -> None:
    definition = parse("a_msgs/A", MIXED)
    assert decode(definition, encode(definition, GOOD, now_us=T0)) == GOOD


def test_json_is_what_rosbags_writes() -> None:
    import numpy as np
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(MIXED, "a_msgs/msg/A"))
    types = store.types
    message = types["a_msgs/msg/A"](
        True, -128, 2**64 - 1, 1.5, "grün", np.array([1, -2], np.int16), np.array([1, 2.5]),
        types["builtin_interfaces/msg/Time"](1, 2), types["builtin_interfaces/msg/Duration"](-1, 999_999_999),
        [types["a_msgs/msg/Inner"](np.array([1, 255], np.uint8), ["a", ""])],
    )  # fmt: skip
    expected = bytes(store.serialize_ros1(message, "a_msgs/msg/A"))
    assert encode(parse("a_msgs/A", MIXED), GOOD, now_us=T0) == expected


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"b": 1}, "b: must be true or false, got 1"),
        ({"small": 128}, "small: must be a number that fits in int8, got 128"),
        ({"small": 1.5}, "small: must be an integer, got 1.5"),
        ({"small": True}, "small: must be an integer, got True"),
        ({"large": -1}, "fits in uint64"),
        ({"f": 1e39}, "fits in float32"),
        ({"f": float("nan")}, "f: must be .*, got nan"),
        ({"f": 10**400}, "f: must be .*, got inf"),
        ({"s": 5}, "s: must be a text, got 5"),
        ({"s": "\ud800"}, "a text of Unicode"),
        ({"two": [1]}, "two: must have 2 elements, got 1"),
        ({"two": 1}, "two: must be a list .*, got 1"),
        ({"many": [1, "2"]}, r"many\.1: must be a number, got '2'"),
        ({"t": 5.0}, "t: must be an object of sec, nanosec, got 5.0"),
        ({"t": {"sec": 1}}, r"t\.nanosec: is missing"),
        ({"t": {"secs": 1}}, r"t\.nanosec: is missing"),
        (
            {"t": {"sec": 1, "secs": 1, "nsecs": 2}},
            "t: must have one spelling of a time, got sec, s",
        ),
        (
            {"t": {"sec": 1, "nanosec": 10**9}},
            r"t\.nanosec: must be an integer from 0 to 9+, got 10{9}",
        ),
        ({"t": {"secs": 1, "nsecs": -1}}, r"t\.nanosec: must be an integer from 0 to 999999999, got -1"),
        ({"ago": {"sec": -1, "nanosec": -1}}, r"ago\.nanosec: must be .*, got -1"),
        ({"inner": [{"raw": [256], "names": ["", ""]}]}, r"inner\.0\.raw\.0: must be .*, got 256"),
        ({"other": 1}, "other: a_msgs/A has no such field"),
    ],
)
def test_json_that_does_not_fit(change: dict[str, Any], error: str) -> None:
    with pytest.raises(MessageError, match=error):
        encode(parse("a_msgs/A", MIXED), {**GOOD, **change}, now_us=T0)


def test_partial_means_zero_and_a_header_means_now() -> None:
    mixed, pose = parse("a_msgs/A", MIXED), parse("geometry_msgs/PoseStamped", POSE)
    zero = decode(mixed, encode(mixed, {"s": "x"}, now_us=T0, partial=True))
    assert zero == {
        "b": False, "small": 0, "large": 0, "f": 0.0, "s": "x", "two": [0, 0], "many": [],
        "t": {"sec": 0, "nanosec": 0}, "ago": {"sec": 0, "nanosec": 0}, "inner": [],
    }  # fmt: skip
    stamped = decode(pose, encode(pose, POSE_MESSAGE, now_us=T0 + 5))
    assert stamped["header"] == {"seq": 0, "stamp": {"sec": T0 // 10**6, "nanosec": 5000}, "frame_id": ""}
    given = {**POSE_MESSAGE, "header": {"seq": 1, "stamp": {"sec": 2, "nanosec": 3}, "frame_id": "map"}}
    assert decode(pose, encode(pose, given, now_us=T0))["header"] == given["header"]


def test_roslibjs_own_spellings_of_times_and_a_header_without_seq() -> None:
    mixed, pose = parse("a_msgs/A", MIXED), parse("geometry_msgs/PoseStamped", POSE)
    theirs = {**GOOD, "t": {"secs": 1, "nsecs": 2}, "ago": {"secs": -1, "nsecs": 999_999_999}}
    assert encode(mixed, theirs, now_us=T0) == encode(mixed, GOOD, now_us=T0)
    header = {"stamp": {"secs": 2, "nsecs": 3}, "frame_id": "map"}
    found = decode(pose, encode(pose, {**POSE_MESSAGE, "header": header}, now_us=T0))
    assert found["header"] == {"seq": 0, "stamp": {"sec": 2, "nanosec": 3}, "frame_id": "map"}
    with pytest.raises(MessageError, match=r"header\.frame_id: is missing"):
        encode(pose, {**POSE_MESSAGE, "header": {"stamp": {"sec": 2, "nanosec": 3}}}, now_us=T0)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(list(GOOD)), inner, max_size=9)
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from([*GOOD, "other"]), JSON), st.booleans())
def test_any_json_is_a_message_or_refused(message: dict[str, Any], partial: bool) -> None:
    definition = parse("a_msgs/A", MIXED)
    try:
        data = encode(definition, {**GOOD, **message}, now_us=T0, partial=partial)
    except MessageError:
        return
    assert encode(definition, decode(definition, data), now_us=T0) == data


@given(st.binary(max_size=80))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    definition = parse("a_msgs/A", MIXED)
    try:
        decode(definition, data)
    except MessageError:
        return
