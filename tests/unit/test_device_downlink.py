"""Commands and other robots' messages on their way to ROS, without ROS and without a network."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import contract
from contract import Command, ContractError, FleetMessage
from device.allowance import Allowance
from device.clock import ManualClock, SystemClock
from device.dispatch import Dispatcher
from device.downlink import Downlink
from device.downlink_config import DownlinkConfig, share_rule
from device.errors import ConfigError, MessageError, SourceError
from device.loopback import Loopback
from device.offset import Offset
from device.ros1_json import decode, encode
from device.ros1_types import Definition, parse
from device.schema import Where, load
from device.uplink import Message

RULE = "=" * 80
HEADER = f"{RULE}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
POSE = f"""Header header
Pose pose
{HEADER}{RULE}
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
{RULE}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
TYPES = {
    "std_msgs/Float64": "float64 data",
    "std_msgs/String": "string data",
    "geometry_msgs/PoseStamped": POSE,
}
T0 = 1_700_000_000_000_000


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


class FakeGraph:
    """ROS topics in memory; what is published on one is heard on it."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.kinds: dict[str, str] = {}
        self.up = True
        self.closed = False
        self.stopped = threading.Event()
        self._handlers: dict[str, Callable[[Mapping[str, str], bytes], None]] = {}

    def definition(self, kind: str) -> Definition:
        if kind not in TYPES:
            raise SourceError(f"{kind} is not installed")
        return parse(kind, TYPES[kind])

    def advertise(self, topic: str, kind: str) -> None:
        self.kinds[topic] = kind

    def publish(self, topic: str, data: bytes) -> bool:
        assert topic in self.kinds
        if self.up:
            self.published.append((topic, data))
        if data == doubles(0):
            self.stopped.set()
        return self.up

    def subscribe(self, topic: str, handler: Callable[[Mapping[str, str], bytes], None]) -> None:
        self._handlers[topic] = handler

    def hear(self, topic: str, kind: str, data: bytes) -> None:
        self._handlers[topic]({"type": kind, "message_definition": TYPES[kind]}, data)

    def start(self) -> None:
        self.closed = False

    def close(self) -> None:
        self.closed = True


CONFIG: dict[str, Any] = {
    "cmd": {
        "speed": {
            "topic": "/commands/motor/speed",
            "type": "std_msgs/Float64",
            "motion": {"lease_s": 0.5, "stop": {"data": 0.0}},
        },
        "say": {"topic": "/say", "type": "std_msgs/String"},
    },
    "fleet": {"pose": {"topic": "/fleet/{robot}/pose", "type": "geometry_msgs/PoseStamped"}},
}
SHARE = {"/pose": {"name": "pose", "rate_hz": 5}}


class Rig:
    def __init__(
        self, robot: str = "car1", *, share: Any = None, uplink: Loopback | None = None, clock: Any = None,
        **config: Any,
    ) -> None:  # fmt: skip
        self.clock = clock or ManualClock(now_us=T0)
        self.dispatcher = Dispatcher()
        self.uplink = uplink or Loopback(self.clock, self.dispatcher)
        self.graph = FakeGraph()
        self.answers: list[tuple[str, int, str | None]] = []
        self.offset: Offset | None = Offset(0.0, 0.0)
        where = Where(Path("car.yaml"))
        self.downlink = Downlink(
            load(DownlinkConfig, {**CONFIG, **config}, where),
            share_rule()(share, where) if share else (),
            robot=robot,
            namespace="iort",
            boot="0badcafe",
            uplink=self.uplink,
            clock=self.clock,
            allowance=Allowance(self.clock),
            graph=self.graph,
            offset=lambda: self.offset,
            answer=lambda name, command, refusal: self.answers.append((name, command.seq, refusal)),
        )
        if uplink is None:
            self.uplink.connect()
        self.seq = 0

    def send(self, message: Any, *, name: str = "speed", raw: bytes | None = None, **changes: Any) -> None:
        now_us = self.clock.now_us()
        command = Command("feedbeef", now_us - 10, self.seq, now_us, 500, message, 300)
        self.seq += 1
        payload = raw if raw is not None else contract.encode_command(replace(command, **changes))
        self.uplink.deliver(f"cmd/iort/car1/{name}", payload)
        self.dispatcher.run_pending()

    def refused(self) -> dict[str, int]:
        found: dict[str, int] = self.downlink.report()["refused"]
        return found


def test_a_command_becomes_a_ros_message() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert rig.graph.published == [
        ("/commands/motor/speed", doubles(2.5)), ("/say", b"\x05\0\0\0hello"),
    ]  # fmt: skip
    assert rig.downlink.report()["commands"]["speed"] == {"passed": 1, "stops": 0}
    assert rig.graph.kinds["/commands/motor/speed"] == "std_msgs/Float64"


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ({}, "data: is missing"),
        ({"data": 1.0, "speed": 2}, "speed: std_msgs/Float64 has no such field"),
        ({"data": "1"}, "data: found '1'; allowed is a number"),
        ({"data": True}, "data: found True"),
        ({"data": None}, "data: found None"),
    ],
)
def test_what_is_not_the_type_is_refused_counted_and_told_once(
    message: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    for _ in range(3):
        rig.send(message)
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/speed malformed": 3}
    assert caplog.text.count(reason) == len(caplog.records) == 1
    rig.clock.advance(60)
    rig.send(message)
    assert "(and 2 more like it)" in caplog.text


@pytest.mark.parametrize(
    "raw",
    [b"", b"\xff", b"[]", b"{}", b'{"v": 1}', b'{"v":1,"session":"feedbeef","message":{"data":NaN}}'],
)
def test_what_is_no_command_is_refused(raw: bytes) -> None:
    rig = Rig()
    rig.send(None, raw=raw)
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/speed malformed": 1}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"sent_us": T0 - 2_000_000, "started_us": T0 - 3_000_000}, "stale"),
        ({"sent_us": T0 + 2_000_000}, "from_the_future"),
        ({"lease_ms": None}, "without_lease"),
    ],
)
def test_motion_is_refused_when_it_is_not_for_now(changes: Any, reason: str) -> None:
    rig = Rig()
    rig.send({"data": 1.0}, **changes)
    assert rig.graph.published == []
    assert rig.refused() == {f"cmd/iort/car1/speed {reason}": 1}


def test_who_asks_is_told_what_became_of_his_command() -> None:
    rig = Rig()
    rig.send({"data": 1.0})
    rig.send({"data": 1.0}, answer=True)
    rig.send({"data": 1.0}, answer=True, seq=1)
    rig.send({"data": "fast"}, answer=True)
    rig.send({"data": 1.0}, answer=True, sent_us=T0 - 600_000, started_us=T0 - 600_000)
    assert rig.answers == [
        ("speed", 1, None),
        ("speed", 1, "repeated or out of order, sent 0.000 s ago, to within 0.000 s"),
        ("speed", 3, "data: found 'fast'; allowed is a number"),
        ("speed", 4, "stale, sent 0.600 s ago, to within 0.000 s"),
    ]


def test_a_deadline_is_judged_by_the_clouds_clock_and_what_may_be_too_old_is() -> None:
    rig = Rig()
    for hour in (-1, 1):
        # The car's clock is an hour off, and knows it to within a tenth of a second.
        rig.offset = Offset(hour * 3_600_000.0, 100.0)
        cloud_us = rig.clock.now_us() + hour * 3_600_000_000
        for age_us in (0, 400_000, 400_001):
            sent_us = cloud_us - age_us
            rig.send({"data": 1.0}, started_us=T0 - 7_200_000_000, sent_us=sent_us, valid_ms=500)
    assert len(rig.graph.published) == 4
    assert rig.refused() == {"cmd/iort/car1/speed stale": 2}


def test_a_car_that_does_not_know_the_clouds_time_does_not_move_but_speaks(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = Rig()
    rig.offset = None
    rig.send({"data": 1.0})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert [topic for topic, _ in rig.graph.published] == ["/say"]
    assert rig.refused() == {"cmd/iort/car1/speed clock_offset_unknown": 1}
    assert "clock offset unknown, sent 0.000 s ago, by its own clock" in caplog.text


def test_a_repeated_delivery_passes_once() -> None:
    rig = Rig()
    rig.send({"data": 1.0}, seq=7, started_us=T0)
    rig.send({"data": 1.0}, seq=7, started_us=T0)
    assert len(rig.graph.published) == 1
    assert rig.refused() == {"cmd/iort/car1/speed repeated_or_out_of_order": 1}


STOP = ("/commands/motor/speed", doubles(0.0))


def test_a_lease_that_ends_stops_the_car(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    assert rig.downlink.tick() == pytest.approx(0.3)
    rig.clock.advance(0.29)
    rig.downlink.tick()
    assert len(rig.graph.published) == 1
    for _ in range(100):
        rig.clock.advance(0.05)
        rig.downlink.tick()
    assert rig.graph.published[1:] == [STOP] * 5
    assert caplog.text.count("nobody renews it, stopping") == 1
    rig.send({"data": 1.0})
    assert rig.graph.published[-1][1] == doubles(1.0)


def test_a_lost_connection_stops_the_car_at_once() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    assert rig.graph.published[1:] == [STOP]


def test_halt_stops_the_car_and_takes_no_more_commands() -> None:
    rig = Rig()
    rig.send({"data": 2.5})
    rig.downlink.halt()
    assert rig.graph.published[1:] == [STOP]
    rig.send({"data": 2.5})
    assert rig.refused() == {"cmd/iort/car1/speed shutting_down": 1}
    rig.downlink.close()
    assert rig.graph.closed


def test_a_car_that_does_not_move_is_not_stopped() -> None:
    rig = Rig()
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    rig.downlink.close()
    assert rig.graph.published == []


def test_without_ros_a_command_is_refused() -> None:
    rig = Rig()
    rig.graph.up = False
    rig.send({"data": 2.5})
    assert rig.refused() == {"cmd/iort/car1/speed no_ros": 1}


def test_in_real_time_the_stop_comes_with_the_end_of_the_lease() -> None:
    rig = Rig(clock=SystemClock())
    stopped = rig.graph.stopped
    rig.downlink.start()
    rig.send({"data": 2.5}, lease_ms=100)
    assert stopped.wait(5)
    rig.downlink.close()
    assert not rig.downlink._thread.is_alive()


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"motion": {"stop": {"speed": 0}}}, "stop: speed: std_msgs/Float64 has no such field"),
        ({"motion": {"stop": 0}}, r"cmd\.speed\.motion\.stop: found 0 .*mapping"),
        ({"motion": {}}, r"motion\.stop: required"),
        ({"motion": {"stop": {}, "lease_s": 60}}, "lease_s: found 60"),
        ({"topic": "speed"}, r"cmd\.speed\.topic: ROS topic 'speed'"),
        ({"type": "Float64"}, "allowed is package/Type"),
        ({"partial": 1}, "partial: found 1"),
    ],
)
def test_a_wrong_configuration(change: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        Rig(cmd={"speed": {**CONFIG["cmd"]["speed"], **change}})


@pytest.mark.parametrize(
    ("config", "error"),
    [
        ({"cmd": {"a/b": CONFIG["cmd"]["say"]}}, "stream name 'a/b'"),
        ({"fleet": {"pose": {"topic": "/pose", "type": "a/B"}}}, "{robot} in it"),
        ({"fleet": {"pose": {"topic": "/{robot}/{robot}", "type": "a/B"}}}, "{robot} in it"),
        ({"share": {"pose": {"name": "pose"}}}, "ROS topic 'pose'"),
        ({"share": {"/a": {"name": "pose"}, "/b": {"name": "pose"}}}, "shared as pose already"),
    ],
)
def test_wrong_names(config: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        Rig(**config)


def test_a_type_that_is_not_installed() -> None:
    with pytest.raises(SourceError, match="a_msgs/A is not installed"):
        Rig(cmd={"say": {"topic": "/say", "type": "a_msgs/A"}})


# Robots among themselves.

POSE_MESSAGE = {
    "pose": {"position": {"x": 1.0, "y": 2.0, "z": 0.0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
}


def pose_bytes() -> bytes:
    return encode(parse("geometry_msgs/PoseStamped", POSE), POSE_MESSAGE, now_us=T0)


def test_two_robots_share_their_poses() -> None:
    clock, dispatcher = ManualClock(now_us=T0), Dispatcher()
    broker = Loopback(clock, dispatcher)
    # One connection holds one handler a filter, so the second robot listens by a filter of its own.
    first = Rig("car-1", share=SHARE, uplink=broker, clock=clock)
    handlers = dict(broker._subscriptions)
    second = Rig("car2", share=SHARE, uplink=broker, clock=clock)
    both = broker._subscriptions["fleet/iort/+/pose"], handlers["fleet/iort/+/pose"]

    def to_both(message: Message) -> None:
        for handle in both:
            handle(message)

    broker._subscriptions["fleet/iort/+/pose"] = to_both
    broker.connect()
    for rig in (first, second):
        rig.graph.hear("/pose", "geometry_msgs/PoseStamped", pose_bytes())
    dispatcher.run_pending()
    assert first.graph.published == [("/fleet/car2/pose", pose_bytes())]
    assert second.graph.published == [("/fleet/car_1/pose", pose_bytes())]
    assert second.graph.kinds["/fleet/car_1/pose"] == "geometry_msgs/PoseStamped"
    assert first.refused() == {}


def fleet(
    rig: Rig,
    robot: str,
    seq: int,
    *,
    boot: str = "0badcafe",
    age_us: int = 0,
    message: Any = None,
    offset_us: int | None = None,
) -> None:
    sent_us = rig.clock.now_us() - age_us
    payload = contract.encode_fleet(FleetMessage(boot, seq, sent_us, message or POSE_MESSAGE, offset_us))
    rig.uplink.deliver(f"fleet/iort/{robot}/pose", payload)
    rig.dispatcher.run_pending()


def test_of_another_robot_only_what_is_new_passes() -> None:
    rig = Rig()
    for seq, boot, age_us in [(0, "0badcafe", 0), (2, "0badcafe", 0), (1, "0badcafe", 0), (0, "1badcafe", 0),
                              (1, "1badcafe", 3_000_000)]:  # fmt: skip
        fleet(rig, "car2", seq, boot=boot, age_us=age_us)
    assert len(rig.graph.published) == 3
    assert rig.refused() == {"fleet pose repeated_or_out_of_order": 1, "fleet pose stale": 1}
    assert rig.downlink.report()["fleet"] == {"pose": {"car2": 3}}


def test_two_clocks_that_are_off_are_compared_by_the_clouds() -> None:
    rig = Rig()
    rig.offset = Offset(3_600_000.0, 1.0)
    # Theirs is an hour ahead of ours, and both of them know.
    for seq, age_us in enumerate((0, 2_000_000, 2_000_001)):
        fleet(rig, "car2", seq, age_us=age_us - 3_600_000_000, offset_us=0)
    assert rig.downlink.report()["fleet"] == {"pose": {"car2": 2}}
    assert rig.refused() == {"fleet pose stale": 1}


def test_two_robots_of_one_ros_name_and_too_many() -> None:
    rig = Rig()
    fleet(rig, "a-b", 0)
    fleet(rig, "a_b", 0)
    for i in range(64):
        fleet(rig, f"car{i}x", 0)
    assert rig.refused() == {"fleet pose name_taken_in_ros": 1, "fleet pose too_many_robots": 1}


def test_another_robots_nonsense_is_refused() -> None:
    rig = Rig()
    fleet(rig, "car2", 0, message={"pose": {"position": {}}})
    rig.uplink.deliver("fleet/iort/car2/pose", b"nonsense")
    rig.dispatcher.run_pending()
    assert rig.graph.published == []
    assert rig.refused() == {"fleet pose malformed": 2}


def shared(rig: Rig) -> list[FleetMessage]:
    rig.dispatcher.run_pending()
    return [
        contract.decode_fleet(m.payload) for m in rig.uplink.published if m.topic == "fleet/iort/car1/pose"
    ]


def test_shared_at_the_rate_and_the_newest() -> None:
    rig = Rig(share=SHARE)
    definition = parse("geometry_msgs/PoseStamped", POSE)
    for i in range(100):
        message = {"pose": {**POSE_MESSAGE["pose"], "position": {"x": float(i), "y": 0.0, "z": 0.0}}}
        rig.graph.hear(
            "/pose", "geometry_msgs/PoseStamped", encode(definition, message, now_us=rig.clock.now_us())
        )
        rig.clock.advance(0.01)
        rig.downlink.tick()
    found = shared(rig)
    assert 5 <= len(found) <= 6
    assert [m.seq for m in found] == list(range(len(found)))
    rig.clock.advance(0.2)
    rig.downlink.tick()
    assert shared(rig)[-1].message["pose"]["position"]["x"] == 99.0


def test_nothing_old_is_shared_after_an_outage() -> None:
    rig = Rig(share=SHARE)
    rig.uplink.cut()
    rig.graph.hear("/pose", "geometry_msgs/PoseStamped", pose_bytes())
    rig.uplink.connect()
    rig.clock.advance(10)
    rig.downlink.tick()
    assert shared(rig) == []


def test_what_is_no_number_is_not_shared() -> None:
    rig = Rig(share={"/x": {"name": "pose"}})
    rig.graph.hear("/x", "std_msgs/Float64", doubles(float("nan")))
    rig.graph.hear("/x", "std_msgs/Float64", b"123")
    assert shared(rig) == []
    assert rig.refused() == {"share /x cannot_be_sent": 2}


# JSON as a ROS message.

MIXED = f"""bool b
int8 small
uint64 large
float32 f
string s
int16[2] two
float64[] many
time t
Inner[] inner
{RULE}
MSG: a_msgs/Inner
uint8[] raw
string[2] names
"""
GOOD = {
    "b": True, "small": -128, "large": 2**64 - 1, "f": 1.5, "s": "grün", "two": [1, -2], "many": [1, 2.5],
    "t": {"sec": 1, "nanosec": 2}, "inner": [{"raw": [1, 255], "names": ["a", ""]}],
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
        types["builtin_interfaces/msg/Time"](1, 2),
        [types["a_msgs/msg/Inner"](np.array([1, 255], np.uint8), ["a", ""])],
    )  # fmt: skip
    expected = bytes(store.serialize_ros1(message, "a_msgs/msg/A"))
    assert encode(parse("a_msgs/A", MIXED), GOOD, now_us=T0) == expected


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"b": 1}, "b: found 1; allowed is true or false"),
        ({"small": 128}, "small: found 128; allowed is a number that fits in int8"),
        ({"small": 1.5}, "small: found 1.5; allowed is an integer"),
        ({"small": True}, "small: found True"),
        ({"large": -1}, "fits in uint64"),
        ({"f": 1e39}, "fits in float32"),
        ({"f": float("nan")}, "f: found nan"),
        ({"f": 10**400}, "f: found inf"),
        ({"s": 5}, "s: found 5; allowed is a text"),
        ({"s": "\ud800"}, "a text of Unicode"),
        ({"two": [1]}, "two: has 1 elements, and must have 2"),
        ({"two": 1}, "two: found 1; allowed is a list"),
        ({"many": [1, "2"]}, r"many\.1: found '2'"),
        ({"t": 5.0}, "t: found 5.0; allowed is an object of sec, nanosec"),
        ({"t": {"sec": 1}}, r"t\.nanosec: is missing"),
        ({"inner": [{"raw": [256], "names": ["", ""]}]}, r"inner\.0\.raw\.0: found 256"),
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
        "t": {"sec": 0, "nanosec": 0}, "inner": [],
    }  # fmt: skip
    stamped = decode(pose, encode(pose, POSE_MESSAGE, now_us=T0 + 5))
    assert stamped["header"] == {"seq": 0, "stamp": {"sec": T0 // 10**6, "nanosec": 5000}, "frame_id": ""}
    given = {**POSE_MESSAGE, "header": {"seq": 1, "stamp": {"sec": 2, "nanosec": 3}, "frame_id": "map"}}
    assert decode(pose, encode(pose, given, now_us=T0))["header"] == given["header"]


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


# The envelopes.

MESSAGES = st.dictionaries(st.text(max_size=3), st.integers() | st.booleans() | st.floats(allow_nan=False, allow_infinity=False) | st.lists(st.none(), max_size=2), max_size=4)  # fmt: skip  # noqa: E501
TIMES = st.integers(0, 2**53 - 1)


@given(
    st.text("0123456789abcdef", min_size=8, max_size=32), st.tuples(TIMES, TIMES), st.integers(0, 2**53),
    st.tuples(st.integers(1, 60_000), st.none() | st.integers(1, 10_000)), MESSAGES,
)  # fmt: skip
def test_a_command_there_and_back(
    session: str, times: tuple[int, int], seq: int, holds: tuple[int, int | None], message: Any
) -> None:
    command = Command(session, min(times), seq, max(times), holds[0], message, holds[1])
    assert contract.decode_command(contract.encode_command(command)) == command


@given(st.integers(0, 2**53), TIMES, MESSAGES)
def test_a_fleet_message_there_and_back(seq: int, sent: int, message: Any) -> None:
    heard = FleetMessage("0badcafe", seq, sent, message)
    assert contract.decode_fleet(contract.encode_fleet(heard)) == heard


@pytest.mark.parametrize(
    "change",
    [
        {"session": "x"}, {"session": None}, {"seq": -1}, {"seq": True}, {"started_us": T0 + 1},
        {"sent_us": 1.5}, {"sent_us": 2**60}, {"valid_ms": 0}, {"valid_ms": 60_001}, {"lease_ms": 0},
        {"lease_ms": 10_001}, {"message": []}, {"message": None}, {"message": {"a": float("nan")}},
        {"message": {"a": "x" * 200_000}}, {"message": {"a": {1, 2}}},
    ],
)  # fmt: skip
def test_a_command_that_is_not_allowed(change: dict[str, Any]) -> None:
    good = Command("feedbeef", T0, 0, T0, 500, {"data": 1}, 300)
    with pytest.raises(ContractError):
        contract.encode_command(replace(good, **change))


@given(st.dictionaries(st.sampled_from(["v", "session", "started_us", "seq", "sent_us", "valid_ms", "lease_ms", "message", "boot"]), st.none() | st.booleans() | st.integers(-1, 2) | st.floats() | st.text(max_size=9) | st.just({})) | st.binary(max_size=40))  # fmt: skip  # noqa: E501
def test_anything_else_is_refused_with_the_contracts_error(content: Any) -> None:
    payload = content if isinstance(content, bytes) else json.dumps(content).encode()
    for read in (contract.decode_command, contract.decode_fleet):
        with pytest.raises(ContractError):
            read(payload)
