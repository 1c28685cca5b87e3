"""A downlink with ROS topics in memory and a broker in the same process.

The topics are those of `FakeGraph.ros`; tests write types and bytes in the form of ROS 1.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from iort_agent.common.schema import Place, load
from iort_agent.common.state import ClockOffset
from iort_agent.control import Bridge
from iort_agent.control.commands import Operator, Sight
from iort_agent.control.config import DownlinkConfig, share_rule
from iort_agent.control.downlink import Downlink
from iort_agent.control.leases import STOP_AHEAD_MS
from iort_agent.errors import SourceError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.ros.json_message import Writer, decode
from iort_agent.ros.ros1_types import OnTrigger
from iort_contract.limits import MessageError, Value
from iort_contract.messages.commands import Command, encode_command
from iort_contract.ros.definition import Definition, layout, parse
from testkit.agent import Loopback, ManualClock, link_of
from testkit.waiting import GUARD_S
from tests.unit.contract.ros.ros_values import HEADER, RULE

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
# What differs in ROS 2.
_STAMP = ("Header header\n", "std_msgs/Header header\n"), ("uint32 seq\ntime ", "builtin_interfaces/Time ")
T0 = 1_700_000_000_000_000
# For the agent, 0.3 s.
LEASE_MS = 300 + STOP_AHEAD_MS


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def definition(kind: str, ros: int) -> Definition:
    """The definition of a type in either ROS."""
    if ros == 1:
        return parse(kind, TYPES[kind])
    text = TYPES[kind]
    for old, new in _STAMP:
        text = text.replace(old, new)
    return parse(kind.replace("/", "/msg/"), text)


def converted(kind: str, data: bytes, ros: int) -> bytes:
    """The bytes of a message in a ROS, from those in the other one; malformed ones as they are."""
    try:
        message = decode(definition(kind, 3 - ros), data)
    except MessageError:
        return data
    header = message.get("header", {})
    if ros == 1:
        header.setdefault("seq", 0)
    else:
        header.pop("seq", None)
    return Writer(definition(kind, ros)).write(message)


class FakeGraph:
    """ROS topics in memory; what is published on one is heard on it."""

    ros = 1
    base = "iort_agent"

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.kinds: dict[str, str] = {}
        self.released: list[str] = []
        self.up = True
        self.closed = False
        self.stopped = threading.Event()
        self.services: dict[str, OnTrigger] = {}
        self._news = threading.Condition()
        self._handlers: dict[str, Callable[[Mapping[str, str], bytes], None]] = {}

    def definition(self, kind: str) -> Definition:
        short = kind.replace("/msg/", "/")
        if short not in TYPES:
            raise SourceError(f"{kind} is not installed")
        assert kind == self.form(short), "as this ROS writes it"
        return definition(short, self.ros)

    def form(self, kind: str) -> str:
        """A type's name as this ROS writes it."""
        return kind if self.ros == 1 else kind.replace("/", "/msg/")

    def advertise(self, topic: str, kind: str) -> None:
        assert self.definition(kind)
        self.kinds[topic] = kind.replace("/msg/", "/")

    def publish(self, topic: str, data: bytes) -> bool:
        if self.ros == 2:
            data = converted(self.kinds[topic], data, 1)
        if self.up:
            with self._news:
                self.published.append((topic, data))
                self._news.notify_all()
        if data == doubles(0):
            self.stopped.set()
        return self.up

    def await_published(self, count: int) -> None:
        """Wait for so many messages."""
        with self._news:
            assert self._news.wait_for(lambda: len(self.published) >= count, GUARD_S), self.published

    def offer(self, service: str, handler: OnTrigger) -> None:
        self.services[service] = handler

    def release(self, topic: str) -> None:
        self.released.append(topic)

    def subscribe(self, topic: str, handler: Callable[[Mapping[str, str], bytes], None]) -> None:
        self._handlers[topic] = handler

    def unsubscribe(self, topic: str, handler: Callable[[Mapping[str, str], bytes], None]) -> None:
        assert self._handlers.pop(topic) == handler

    def hear(self, topic: str, kind: str, data: bytes) -> None:
        if self.ros == 2:
            data = converted(kind, data, 2)
        told = definition(kind, self.ros)
        self._handlers[topic]({"type": told.kind, "message_definition": layout(told)}, data)

    def waits(self) -> str | None:
        return None

    def start(self) -> None:
        self.closed = False

    def close(self) -> None:
        self.closed = True


class FakeGuard:
    """What the guard was told, and when."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.told: list[tuple[float, float | None, bool]] = []
        self.stops = self.up = True
        self.left = False

    def ready(self) -> bool:
        return self.up

    def tell(self, _topic: str, until: float | None, *, held: bool) -> bool:
        self.told.append((self.clock.monotonic(), until, held))
        return True

    def tick(self, *, stops: bool = True) -> None:
        self.stops = stops

    def close(self, *, leave: bool = False) -> None:
        self.left = leave


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


class Rig:
    def __init__(
        self, robot: str = "car1", *, share: Any = None, uplink: Loopback | None = None, clock: Any = None,
        graph: Any = None, guard: Any = None, sight: Sight | None = None, **config: Any,
    ) -> None:  # fmt: skip
        self.clock = clock or ManualClock(now_us=T0)
        self.dispatcher = Dispatcher()
        self.uplink = uplink or Loopback(self.clock, self.dispatcher)
        self.graph = FakeGraph()
        self.answers: list[tuple[str, int, str | None]] = []
        self.drove: list[Mapping[str, Value]] = []
        self.settings_known = True
        self.offset: ClockOffset | None = ClockOffset(0.0, 0.0)
        where = Place(Path("car.yaml"))
        if graph is None:
            config = {**CONFIG, **config}
            for name in ("cmd", "fleet"):
                config[name] = {
                    key: {**settings, "type": self.graph.form(settings["type"])}
                    for key, settings in config.get(name, {}).items()
                }
        self.downlink = Downlink(
            load(DownlinkConfig, config, where),
            share_rule()(share, where) if share else (),
            Bridge(link_of(self.uplink, self.clock, robot=robot), graph or self.graph, lambda: self.offset),
            boot="0badcafe",
            guard=guard,
            sight=sight,
            operator=Operator(
                lambda name, command, refusal: self.answers.append((name, command.seq, refusal)),
                self.drove.append,
                lambda: self.settings_known,
            ),
        )
        if uplink is None:
            self.uplink.connect()
        self.seq = 0

    def send(self, message: Any, *, name: str = "speed", raw: bytes | None = None, **changes: Any) -> None:
        now_us = self.clock.now_us()
        command = Command("feedbeef", now_us - 10, self.seq, now_us, 500, message, LEASE_MS)
        self.seq += 1
        payload = raw if raw is not None else encode_command(replace(command, **changes))
        self.uplink.deliver(f"cmd/iort/car1/{name}", payload)
        self.dispatcher.run_pending()

    def refused(self) -> dict[str, int]:
        found: dict[str, int] = self.downlink.report()["refused"]
        return found


POSE_MESSAGE = {
    "pose": {"position": {"x": 1.0, "y": 2.0, "z": 0.0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
}
