"""What rosapi says of a type, and messages that came again."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings

from iort_agent.sources.rosbridge import Repeats
from iort_agent.sources.rosbridge.rosapi import ANSWER_S, Rosapi, Structure, from_text, from_typedefs
from iort_contract.limits import MessageError
from iort_contract.ros.definition import RULE, Definition, md5sum, parse
from testkit.agent import ManualClock
from tests.unit.agent.control.downlink_rig import POSE
from tests.unit.contract.ros.ros_values import HEADER, definitions, text_of

STATUS = """# what it is
byte OK=0
string NAME= a name # and more
string DEBUG=1
byte level  # how bad
string name
std_msgs/Header[] headers
KeyValue[] values
"""
STATUS += f"{HEADER}{RULE}\nMSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n"
FIX = f"""Header header
NavSatStatus status
float64[9] position_covariance
uint8 COVARIANCE_TYPE_UNKNOWN = 0
uint8 COVARIANCE_TYPE_KNOWN = 3
uint8 position_covariance_type
{HEADER}{RULE}
MSG: sensor_msgs/NavSatStatus
int8 STATUS_NO_FIX =  -1        # unable to fix position
int8 status
uint16 SERVICE_GPS =     1
uint16 service
"""


@pytest.mark.parametrize(
    ("kind", "text", "expected"),
    [
        # As genmsg 0.6.0 computes them; the first three are what every ROS 1 knows.
        ("std_msgs/Header", "uint32 seq\ntime stamp\nstring frame_id\n", "2176decaecbce78abc3b96ef049fabed"),
        ("geometry_msgs/PoseStamped", POSE, "d3812c3cbc69362b77dc0b19b345f8f5"),
        ("std_msgs/Empty", "", "d41d8cd98f00b204e9800998ecf8427e"),
        ("diagnostic_msgs/DiagnosticStatus", STATUS, "c22c882f53518a5162a0a2fa51a422bd"),
        ("sensor_msgs/NavSatFix", FIX, "766e6ea38f87de6f40746ad5e0c5d91e"),
    ],
)
def test_the_md5sum_is_ros_own(kind: str, text: str, expected: str) -> None:
    assert md5sum(parse(kind, text), text) == expected


def typedef(kind: str, *fields: tuple[str, str, int], **members: Any) -> dict[str, Any]:
    names, kinds, lengths = zip(*fields) if fields else ((), (), ())
    return {
        "type": kind, "fieldnames": list(names), "fieldtypes": list(kinds), "fieldarraylen": list(lengths),
        "examples": [], "constnames": [], "constvalues": [], **members,
    }  # fmt: skip


def as_typedefs(definition: Definition) -> list[dict[str, Any]]:
    return [
        typedef(
            kind,
            *(
                (field.name, field.kind, -1 if field.length is None else max(field.length, 0))
                for field in fields
            ),
        )
        for kind, fields in reversed(list(definition.types.items()))
    ]


@settings(deadline=None)  # the first example loads what the others use
@given(definitions())
def test_the_fields_are_the_definition(definition: Definition) -> None:
    found = from_typedefs(definition.kind, as_typedefs(definition))
    assert found.definition.types == definition.types
    assert found.md5sum == md5sum(definition, text_of(definition))


def test_what_ros_2_says_is_the_message_of_ros_1() -> None:
    found = from_typedefs(
        "geometry_msgs/msg/PoseStamped",
        [
            typedef(
                "geometry_msgs/PoseStamped",
                ("_header", "std_msgs/Header", -1),
                ("_pose", "geometry_msgs/Pose", -1),
            ),
            typedef(
                "std_msgs/Header",
                ("_stamp", "builtin_interfaces/Time", -1),
                ("_frame_id", "string", -1),
            ),
            typedef("builtin_interfaces/Time", ("_sec", "int32", -1), ("_nanosec", "uint32", -1)),
            typedef(
                "geometry_msgs/msg/Pose",
                ("position", "geometry_msgs/msg/Point", -1),
                ("orientation", "geometry_msgs/msg/Quaternion", -1),
            ),
            typedef("geometry_msgs/Point", *((name, "double", -1) for name in "xyz")),
            typedef("geometry_msgs/Quaternion", *((name, "double", -1) for name in "xyzw")),
        ],
    )
    assert found.md5sum == "d3812c3cbc69362b77dc0b19b345f8f5", "of geometry_msgs/PoseStamped in ROS 1"
    assert found.kind == "geometry_msgs/PoseStamped"
    assert found.definition.stamped()


def test_the_names_of_ros_2() -> None:
    odd = typedef(
        "a_msgs/Odd",
        ("flag", "boolean", -1),
        ("raw", "octet", 0),
        ("name", "string<10>", -1),
        ("some", "double, 3", 0),
        ("three", "float", 3),
        ("after", "builtin_interfaces/Duration", -1),
    )
    assert from_typedefs("a_msgs/msg/Odd", [odd]).text == (
        "bool flag\nbyte[] raw\nstring name\nfloat64[] some\nfloat32[3] three\nduration after\n"
    )


@pytest.mark.parametrize(
    "typedefs",
    [
        None, [], [7], [{}], [typedef("a_msgs/B")], [typedef("a_msgs/A", ("x", "b_msgs/Gone", -1))],
        [typedef("a_msgs/A", ("x y", "bool", -1))], [typedef("a_msgs/A", ("x", "bool\nint8 y", -1))],
        [typedef("a_msgs/A", ("x", "a_msgs/A", -1))], [typedef("a_msgs/A", ("x", "bool", "many"))],
    ],
)  # fmt: skip
def test_an_answer_that_is_none(typedefs: Any) -> None:
    with pytest.raises(MessageError, match="a_msgs/A"):
        from_typedefs("a_msgs/A", typedefs)


class Rig:
    """Rosapi with the calls that it sends, and what it finds."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.found: list[tuple[str, Structure | None]] = []
        self.clock = ManualClock()
        self.rosapi = Rosapi(self.sent.append, lambda *found: self.found.append(found), self.clock)

    def answer(self, values: Any, *, call: int = -1, result: bool = True) -> None:
        self.rosapi.answer(
            {"op": "service_response", "id": self.sent[call]["id"], "values": values, "result": result}
        )

    def asked(self) -> list[tuple[str, Any]]:
        return [(call["service"].rpartition("/")[2], call["args"]) for call in self.sent]


LISTED = {"topics": ["/a", "/b"], "types": ["a_msgs/A", "a_msgs/B"], "typedefs_full_text": ["bool a", ""]}


def test_one_call_tells_of_every_topic() -> None:
    rig = Rig()
    rig.rosapi.ask("/a", None)
    rig.rosapi.ask("/a2", None)
    assert rig.asked() == [("topics_and_raw_types", {})]
    rig.answer({**LISTED, "topics": ["/a", "/a2"], "typedefs_full_text": ["bool a", "bool b"]})
    assert rig.found == [
        ("/a", from_text("a_msgs/A", "bool a")),
        ("/a2", from_text("a_msgs/B", "bool b")),
    ]


def test_of_a_type_whose_text_is_not_given_the_fields_are_asked_for() -> None:
    rig = Rig()
    rig.rosapi.ask("/b", None)
    rig.answer(LISTED)
    rig.answer({"typedefs": [typedef("a_msgs/B", ("b", "int8", -1))]})
    assert rig.asked()[1:] == [("message_details", {"type": "a_msgs/B"})]
    assert rig.found == [("/b", from_text("a_msgs/B", "int8 b\n"))]


def test_of_ros_2_the_fields_are_asked_for() -> None:
    rig = Rig()
    rig.rosapi.ask("/a", None)
    rig.answer({**LISTED, "types": ["a_msgs/msg/A", "a_msgs/msg/B"], "typedefs_full_text": ["bool a=1", ""]})
    rig.answer({"typedefs": [typedef("a_msgs/A", ("_a", "boolean", -1))]})
    assert rig.found == [("/a", from_text("a_msgs/A", "bool a\n"))]


@pytest.mark.parametrize("configured", [None, "a_msgs/A"])
def test_an_old_rosapi(configured: str | None) -> None:
    rig = Rig()
    rig.rosapi.ask("/a", configured)
    rig.answer("Service /rosapi/topics_and_raw_types does not exist", result=False)
    if configured is None:
        rig.answer({"type": "a_msgs/A"})
    rig.answer({"typedefs": [typedef("a_msgs/A", ("a", "bool", -1), constnames=["ONE"], constvalues=["1"])]})
    asked = [service for service, _ in rig.asked()]
    assert ("topic_type" in asked) == (configured is None)
    assert rig.found == [("/a", from_text("a_msgs/A", "bool a\n"))]


@pytest.mark.parametrize(
    "answers",
    [
        [("no such service", False), ("no such service", False)],
        [({"topics": 7}, True), ({"type": ""}, True)],
        [({"topics": ["/a"], "types": ["a_msgs/A"], "typedefs_full_text": ["no definition"]}, True), ("", 0)],
        [([], True), ({"type": "a_msgs/A"}, True), ({"typedefs": "none"}, True)],
        [("", False), ({"type": "a_msgs/A"}, True), ({}, True)],
    ],
)
def test_where_nothing_can_be_had(answers: list[Any]) -> None:
    rig = Rig()
    rig.rosapi.ask("/a", None)
    for values, result in answers:
        rig.answer(values, result=bool(result))
    assert rig.found == [("/a", None)]


def test_no_answer_in_time() -> None:
    rig = Rig()
    rig.rosapi.ask("/a", None)
    for calls in (1, 2):
        rig.clock.advance(ANSWER_S - 1)
        rig.rosapi.look()
        assert len(rig.sent) == calls
        rig.clock.advance(1)
        rig.rosapi.look()
    assert rig.found == [("/a", None)]
    rig.answer(LISTED, call=0)
    assert rig.found == [("/a", None)], "too late"


def test_what_another_server_said_is_forgotten() -> None:
    rig = Rig()
    rig.rosapi.ask("/a", None)
    rig.rosapi.restart()
    rig.answer(LISTED)
    assert rig.found == []
    rig.rosapi.ask("/a", None)
    rig.answer(LISTED)
    assert rig.found == [("/a", from_text("a_msgs/A", "bool a"))]


MAP = b'{"op": "publish", "topic": "/map", "msg": {"data": "a map"}}'


def test_a_latched_message_comes_with_every_subscription() -> None:
    repeats = Repeats()
    repeats.subscribed(0.0)
    assert not repeats.came_before(MAP, 0.1, stamped=False)
    for n in range(1, 5):
        repeats.subscribed(100.0 * n)
        assert repeats.came_before(MAP, 100.0 * n + 1, stamped=False)
    assert not repeats.came_before(b"another map", 500.0, stamped=False)


def test_each_of_several_latching_publishers_comes_again() -> None:
    repeats = Repeats()
    parts = [b"left", b"right", b"top"]
    assert not any(repeats.came_before(part, 0.0, stamped=True) for part in parts)
    repeats.subscribed(10.0)
    assert not repeats.came_before(b"new", 10.1, stamped=True)
    assert all(repeats.came_before(part, 10.2, stamped=True) for part in reversed(parts))
    assert not repeats.came_before(b"left", 10.3, stamped=True), "once for each subscription"


def test_a_topic_that_repeats_itself_is_taken_as_it_comes() -> None:
    repeats = Repeats()
    assert [repeats.came_before(b"on", float(n), stamped=False) for n in range(3)] == [False] * 3
    repeats.subscribed(3.0)
    assert not repeats.came_before(b"on", 3.1, stamped=False)


def test_long_after_the_subscription_it_is_a_message_like_any() -> None:
    repeats = Repeats()
    repeats.came_before(MAP, 0.0, stamped=False)
    repeats.subscribed(1.0)
    assert not repeats.came_before(MAP, 60.0, stamped=False)
