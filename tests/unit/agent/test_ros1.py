"""ROS 1 messages from and to JSON, and how the node connects to publishers."""

from __future__ import annotations

import base64
import io
import json
import math
import resource
import socket
import struct
import sys
import threading
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iort_agent.ros import ros1_master, ros1_node
from iort_agent.ros.json_message import Writer, decode, encode
from iort_contract.limits import MessageError
from iort_contract.ros.definition import DURATION, LETTERS, STRING, TIME, Definition, Field, parse
from testkit.waiting import GUARD_S
from tests.unit.agent.control.downlink_rig import POSE, POSE_MESSAGE, RULE, T0
from tests.unit.contract.ros.ros_values import by_rosbags, definitions, values

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


# What neither writer takes, what only a strict one refuses, and what only the other one meets.
BOTH = [
    ({"b": None}, "b: must be true or false, got None"),
    ({"small": 128}, "small: must be a number that fits in int8, got 128"),
    ({"small": 1.5}, "small: must be an integer, got 1.5"),
    ({"small": None}, "small: must be an integer, got None"),
    ({"large": -1}, "fits in uint64"),
    ({"f": 1e39}, "fits in float32"),
    ({"f": "1"}, "f: must be a number, got '1'"),
    ({"s": 5}, "s: must be a text, got 5"),
    ({"s": "\ud800"}, "s: must be a text of Unicode"),
    ({"two": [1]}, "two: must have 2 elements, got 1"),
    ({"two": {"0": 1}}, "two: must be a list of up to"),
    ({"many": 7}, "many: must be a list of up to .*, got 7"),
    ({"many": [1, "2"]}, r"many\.1: must be a number, got '2'"),
    ({"t": 5.0}, "t: must be an object of sec, nanosec, got 5.0"),
    ({"t": {"sec": 1}}, r"t\.nanosec: is missing"),
    ({"t": {"secs": 1}}, r"t\.nanosec: is missing"),
    ({"t": {"sec": 1, "secs": 1, "nsecs": 2}}, "t: must have one spelling of a time, got sec, s"),
    ({"inner": [{"raw": [256], "names": ["", ""]}]}, r"inner\.0\.raw\.0: must be .*, got 256"),
    (
        {"inner": [{"raw": [], "names": ["", ""], "more": 1}]},
        r"inner\.0\.more: a_msgs/Inner has no such field",
    ),
    ({"inner": [None]}, r"inner\.0: must be an object of raw, names, got None"),
    ({"other": 1}, "other: a_msgs/A has no such field"),
]
STRICT = [
    ({"b": 1}, "b: must be true or false, got 1"),
    ({"small": True}, "small: must be an integer, got True"),
    ({"f": float("nan")}, "f: must be .*, got nan"),
    ({"f": 10**400}, "f: must be .*, got inf"),
    ({"t": {"sec": 1, "nanosec": 10**9}}, r"t\.nanosec: must be an integer from 0 to 9+, got 10{9}"),
    ({"t": {"secs": 1, "nsecs": -1}}, r"t\.nanosec: must be an integer from 0 to 999999999, got -1"),
    ({"ago": {"sec": -1, "nanosec": -1}}, r"ago\.nanosec: must be .*, got -1"),
    ({"inner": [{"raw": "AQI=", "names": ["", ""]}]}, r"inner\.0\.raw: must be a list"),
]
LENIENT = [
    ({"inner": [{"raw": "a", "names": ["", ""]}]}, r"inner\.0\.raw: must be base64"),
]


@pytest.mark.parametrize(
    ("strict", "change", "error"),
    [
        *((strict, *case) for strict in (True, False) for case in BOTH),
        *((True, *case) for case in STRICT),
        *((False, *case) for case in LENIENT),
    ],
)
def test_json_that_does_not_fit(*, strict: bool, change: dict[str, Any], error: str) -> None:
    with pytest.raises(MessageError, match=error):
        Writer(parse("a_msgs/A", MIXED), strict=strict).write({**GOOD, **change})


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


# What a rosbridge server sends, as the bytes of the ROS 1 message that it was made of.

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


def as_rosbridge(
    definition: Definition, value: Any, field: Field | None = None, *, ros2: bool = False
) -> Any:
    """Convert a message as message_conversion.py of rosbridge_suite 0.11.17; bytes are its `uint8[]`."""
    field = field or Field("", definition.kind, None)
    if field.length is not None and field.kind in ("uint8", "char"):
        return base64.standard_b64encode(bytes(value)).decode("ascii")
    if field.length is not None:
        one = Field(field.name, field.kind, None)
        return [as_rosbridge(definition, item, one, ros2=ros2) for item in value]
    if field.kind in ("float32", "float64"):
        return value if math.isfinite(value) else None
    if field.kind in (TIME, DURATION):
        names = ("sec", "nanosec") if ros2 else ("secs", "nsecs")
        return {names[0]: value["sec"], names[1]: value["nanosec"]}
    if field.kind in LETTERS or field.kind == STRING:
        return value
    return {
        inner.name: as_rosbridge(definition, value[inner.name], inner, ros2=ros2)
        for inner in definition.fields(field.kind)
        if inner.name in value
    }


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


# Attempts to connect to a publisher, in the place of rospy's own.

TOPIC, URI = "/wheel", "http://127.0.0.1:1"
CHOSEN = ["TCPROS", "127.0.0.1", 2]


class Rospy:
    """A subscriber, its connections, and a publisher whose answers the test gives."""

    def __init__(self) -> None:
        self.connections: list[str] = []
        self.asked, self.answer = threading.Semaphore(0), threading.Semaphore(0)
        self.protocol_handlers = [self]

    def get_subscriber_impl(self, topic: str) -> Any:
        return SimpleNamespace(has_connection=self.connections.__contains__) if topic == TOPIC else None

    def get_supported(self) -> list[list[str]]:
        return [["TCPROS"]]

    def supports(self, protocol: str) -> bool:
        return protocol == "TCPROS"

    def create_transport(self, _topic: str, uri: str, chosen: list[Any]) -> tuple[int, str, int]:
        assert chosen == CHOSEN
        self.connections.append(uri)
        return 1, "", 0

    def requestTopic(self, *asked: Any) -> tuple[int, str, list[Any]]:  # noqa: N802 - ROS' name
        assert asked == ("/iort_agent", TOPIC, [["TCPROS"]])
        self.asked.release()
        assert self.answer.acquire(timeout=GUARD_S)
        return 1, "", CHOSEN


@pytest.fixture
def rospy(monkeypatch: pytest.MonkeyPatch) -> Rospy:
    found, handlers = Rospy(), type("Handlers", (), {})
    for name, module in (
        ("masterslave", SimpleNamespace(ROSHandler=handlers)),
        ("registration", SimpleNamespace(get_topic_manager=lambda: found)),
    ):
        monkeypatch.setitem(sys.modules, f"rospy.impl.{name}", module)
    monkeypatch.setattr(ros1_master, "proxy", lambda *_: found)
    ros1_master.mend("/iort_agent")
    found.connect = lambda topic=TOPIC: handlers._connect_topic(found, topic, URI)
    return found


def test_two_attempts_at_once_make_one_connection(rospy: Any) -> None:
    first = threading.Thread(target=rospy.connect)
    first.start()
    assert rospy.asked.acquire(timeout=GUARD_S)
    # The second begins while the first waits for its answer.
    rospy.connect()
    rospy.answer.release()
    first.join()
    rospy.connect()
    assert rospy.connections == [URI]


def test_a_publisher_that_did_not_answer_is_tried_again(rospy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*_: Any) -> None:
        raise TimeoutError

    answering = rospy.requestTopic
    monkeypatch.setattr(rospy, "requestTopic", silent)
    with pytest.raises(TimeoutError):
        rospy.connect()
    monkeypatch.setattr(rospy, "requestTopic", answering)
    rospy.answer.release()
    rospy.connect()
    assert rospy.connections == [URI]


def test_a_topic_without_subscriber_is_not_connected(rospy: Any) -> None:
    rospy.connect("/other")
    assert rospy.connections == []


class Subscription(SimpleNamespace):
    """rospy's protocol of a subscription."""


class Transport:
    """rospy's connection to a publisher. By itself it reads what came with the connection's header."""

    done = False
    header = MappingProxyType({"callerid": "/pub"})

    def __init__(self, protocol: Any, early: bytes = b"") -> None:
        self.protocol, self.read_buff = protocol, io.BytesIO()
        self.read_buff.write(early)
        self.socket: socket.socket | None = None

    def receive_once(self) -> list[bytes]:
        return [self.read_buff.getvalue()]


def test_messages_are_handed_over_as_they_are_on_the_socket(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    taken: list[Any] = []

    def take(header: Any, data: bytes) -> None:
        taken.append((header, data))
        assert data != b"bad"

    transports = type("Transports", (Transport,), {})
    for name, module in (
        ("impl.tcpros_base", SimpleNamespace(TCPROSTransport=transports)),
        ("impl.tcpros_pubsub", SimpleNamespace(TCPROSSub=Subscription)),
        ("exceptions", SimpleNamespace(TransportTerminated=EOFError, TransportException=BufferError)),
    ):
        monkeypatch.setitem(sys.modules, f"rospy.{name}", module)
    ros1_node._read_directly({TOPIC: [take]})
    messages = [b"one", b"", b"bad", b"x" * 1000]
    transport = transports(Subscription(resolved_name=TOPIC, buff_size=100))
    publisher, transport.socket = socket.socketpair()
    with transport.socket:
        with publisher:
            publisher.sendall(b"".join(struct.pack("<I", len(data)) + data for data in messages) + b"\x09\0")
        with pytest.raises(EOFError):
            transport.receive_once()
    assert taken == [(Transport.header, data) for data in messages]
    assert "a message could not be taken" in caplog.text
    # A message beyond the memory ends the connection: what follows is the middle of a message.
    publisher, transport.socket = socket.socketpair()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**30, limits[1]))
    try:
        with transport.socket, publisher:
            publisher.sendall(struct.pack("<I", 2**32 - 1) + struct.pack("<I", 1) * 50)
            with pytest.raises(BufferError):
                transport.receive_once()
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert len(taken) == len(messages)
    # rospy's own way for what came with the header, and for a service.
    assert transports(Subscription(), early=b"rest").receive_once() == [b"rest"]
    assert transports(SimpleNamespace()).receive_once() == [b""]
