"""What a rosbridge server sends, as the bytes of the ROS 1 message that it was made of."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iort_agent.ros1.json_message import Writer, decode
from iort_contract.limits import MessageError
from iort_contract.ros1.definition import Definition, parse
from tests.rosbridge_json import as_rosbridge
from tests.unit.contract.ros1.ros1_values import HEADER, by_rosbags, definitions, values

pytest.importorskip("rosbags")


def without_numbers(value: Any) -> Any:
    """What rosbridge does to NaN and the infinities."""
    if isinstance(value, dict):
        return {name: without_numbers(member) for name, member in value.items()}
    if isinstance(value, list):
        return [without_numbers(item) for item in value]
    return math.nan if isinstance(value, float) and not math.isfinite(value) else value


def nulls(value: Any) -> int:
    if isinstance(value, (dict, list)):
        return sum(map(nulls, value.values() if isinstance(value, dict) else value))
    return int(value is None)


@settings(deadline=None)  # rosbags makes classes of each definition
@given(st.data())
def test_any_message_is_what_rosbags_writes(data: Any) -> None:
    definition = data.draw(definitions())
    message = data.draw(values(definition))
    sent = json.loads(json.dumps(as_rosbridge(definition, message)))
    writer = Writer(definition)
    assert writer.write(sent) == by_rosbags(definition, without_numbers(message))
    assert writer.nulls == nulls(sent)
    ros2 = json.loads(json.dumps(as_rosbridge(definition, message, ros2=True)))
    assert writer.write(ros2) == writer.write(sent)


MIXED = f"""Header header
bool b
int8 small
float32 f
string s
int16[2] two
float64[] many
uint8[] raw
char[3] three
bool[] flags
byte[] signed
time t
Inner[] inner
Plain[2] plain
{HEADER}{"=" * 80}
MSG: a_msgs/Inner
string[2] names
{"=" * 80}
MSG: a_msgs/Plain
float32 x
duration d
"""
GOOD: dict[str, Any] = {
    "header": {"seq": 3, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "map"},
    "b": True, "small": -128, "f": 1.5, "s": "grün", "two": [1, -2], "many": [1, 2.5], "raw": "AQL/",
    "three": "YWJj", "flags": [True, False], "signed": [-1, 127], "t": {"secs": 4, "nsecs": 5},
    "inner": [{"names": ["a", ""]}],
    "plain": [{"x": 1, "d": {"secs": -1, "nsecs": 6}}, {"x": None, "d": {"secs": 0, "nsecs": 0}}],
}  # fmt: skip


def mixed() -> Definition:
    return parse("a_msgs/A", MIXED)


def test_what_rosbridge_sends() -> None:
    writer = Writer(mixed())
    back = decode(mixed(), writer.write(GOOD))
    assert math.isnan(back["plain"][1].pop("x"))
    assert writer.nulls == 1
    assert back == {
        **GOOD,
        "header": {"seq": 3, "stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
        "raw": [1, 2, 255], "three": [97, 98, 99], "t": {"sec": 4, "nanosec": 5},
        "plain": [{"x": 1, "d": {"sec": -1, "nanosec": 6}}, {"d": {"sec": 0, "nanosec": 0}}],
    }  # fmt: skip


def test_a_header_of_ros_2_has_no_seq() -> None:
    header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"}
    message = {**GOOD, "header": header, "raw": [1, 2, 255]}
    assert decode(mixed(), Writer(mixed()).write(message))["header"] == {**header, "seq": 0}


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"b": None}, "b: must be true or false, got None"),
        ({"small": 128}, "small: must be a number that fits in int8, got 128"),
        ({"small": None}, "small: must be an integer, got None"),
        ({"small": 1.5}, "small: must be an integer, got 1.5"),
        ({"f": 1e39}, "f: must be a number that fits in float32"),
        ({"f": "1"}, "f: must be a number, got '1'"),
        ({"s": 5}, "s: must be a text, got 5"),
        ({"s": "\ud800"}, "s: must be a text of Unicode"),
        ({"two": [1]}, "two: must have 2 elements, got 1"),
        ({"two": {"0": 1}}, "two: must be a list of up to"),
        ({"many": 7}, "many: must be a list of up to .*, got 7"),
        ({"raw": "a"}, "raw: must be base64"),
        ({"raw": [256]}, r"raw\.0: must be a number that fits in uint8, got 256"),
        ({"three": "YWI="}, "three: must have 3 elements, got 2"),
        ({"t": {"secs": 1}}, r"t\.nanosec: is missing"),
        ({"t": {"secs": 1, "nanosec": 2}}, "t: must have one spelling of a time"),
        ({"inner": [{"names": ["a", "b"], "more": 1}]}, r"inner\.0\.more: a_msgs/Inner has no such field"),
        ({"inner": [None]}, r"inner\.0: must be an object of names, got None"),
        ({"plain": [{"x": 1}, {"x": 1}]}, r"plain\.0\.d: is missing"),
        ({"header": {"seq": 1, "frame_id": ""}}, r"header\.stamp: is missing"),
        ({"other": 1}, "other: a_msgs/A has no such field"),
    ],
)
def test_what_does_not_fit(change: dict[str, Any], error: str) -> None:
    with pytest.raises(MessageError, match=error):
        Writer(mixed()).write({**GOOD, **change})


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(list(GOOD)), inner),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from([*GOOD, "other"]), JSON) | JSON)
def test_any_json_is_a_message_or_refused(message: Any) -> None:
    whole = {**GOOD, **message} if isinstance(message, dict) else message
    try:
        data = Writer(mixed()).write(whole)
    except MessageError:
        return
    decode(mixed(), data)
