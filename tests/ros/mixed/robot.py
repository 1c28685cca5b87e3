"""A robot of many topics: every common shape of message, and some rare ones.

`mixed_publisher.py` publishes them, in processes under ROS' own Python, and the tests compare with them.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from testkit.ros1_types import MESSAGES, SIZES, Message, serialize


class Topic(NamedTuple):
    """A topic of one publisher. ``lengths`` has array lengths by field name; other arrays have up to four
    elements, a different number in each message. Stamps are multiples of ``grid_us``, on a clock that is
    ``behind_us`` late.
    """

    name: str
    kind: str
    rate_hz: float
    lengths: Mapping[str, int] = {}
    latched: bool = False
    grid_us: int = 1
    behind_us: int = 0

    @property
    def message(self) -> Message:
        return MESSAGES[self.kind]

    @property
    def stream(self) -> str:
        return self.name[1:].replace("/", "_")


_ARM, _GRIPPER = (dict.fromkeys(("name", "position", "velocity", "effort"), n) for n in (6, 2))
_BEACONS = Topic("/beacons", "geometry_msgs/PointStamped", 50, grid_us=20_000)
_JOINTS = Topic("/joint_states", "sensor_msgs/JointState", 50, _ARM)
# Node -> its topics: two publishers of a topic are two nodes.
NODES: dict[str, list[Topic]] = {
    "base": [
        Topic("/sensors/core", "vesc_msgs/VescStateStamped", 50),
        Topic("/tf", "tf2_msgs/TFMessage", 40),
        Topic("/tf_static", "tf2_msgs/TFMessage", 0, {"transforms": 5}, latched=True),
        Topic("/scan", "sensor_msgs/LaserScan", 10, {"ranges": 720, "intensities": 0}),
        Topic("/odom", "nav_msgs/Odometry", 30),
        Topic("/camera/small", "sensor_msgs/Image", 2, {"data": 64 * 48 * 3}),
        Topic("/camera/large", "sensor_msgs/Image", 0.2, {"data": 640 * 480 * 3}),
        Topic("/diagnostics", "diagnostic_msgs/DiagnosticArray", 2),
        Topic("/heartbeat", "std_msgs/Empty", 5),
        Topic("/map", "nav_msgs/OccupancyGrid", 0, {"data": 100 * 100}, latched=True),
        Topic("/plan", "nav_msgs/Path", 2),
        Topic("/battery", "std_msgs/Float32", 1),
        Topic("/note", "std_msgs/String", 2),
        Topic("/ticks", "std_msgs/UInt64MultiArray", 10),
        Topic("/raw", "std_msgs/ByteMultiArray", 10),
        Topic("/sync", "std_msgs/Header", 10),
        Topic("/lab/envelope", "lab_msgs/Envelope", 5),
        Topic("/lab/limits", "lab_msgs/Limits", 10),
        Topic("/lab/empties", "lab_msgs/Empties", 5),
        _BEACONS,
        _JOINTS,
    ],
    "rear": [_BEACONS._replace(behind_us=2_000_000), _JOINTS._replace(rate_hz=20, lengths=_GRIPPER)],
    "imu": [Topic("/imu", "sensor_msgs/Imu", 1000)],
}
TOPICS = {topic.name: topic for topics in NODES.values() for topic in topics}

_EDGES: dict[str, list[Any]] = {
    "float32": [math.nan, math.inf, -0.0],
    "float64": [math.nan, -math.inf, -0.0, 5e-324],
    "uint64": [2**53 + 1, 2**64 - 1],
    "int64": [-(2**63), 2**53 + 1],
}
_WORDS = (b"", b"base_link", "grün".encode(), b"not UTF-8: \xff\xfe", b"\xc3", b"a\0b", b"joint_1")


class Values:
    """Values as sensors send them: a few digits, sometimes an edge case; covariances stay constant."""

    def __init__(self, seed: int, lengths: Mapping[str, int]) -> None:
        self._random = random.Random(seed)
        self._lengths = lengths

    def number(self, kind: str, name: str) -> bytes:
        if "covariance" in name:
            return bytes(SIZES[kind])
        chance = self._random
        if kind in {"float32", "float64"}:
            value = chance.choice(_EDGES[kind]) if chance.random() < 0.01 else round(chance.gauss(0, 3), 3)
            return struct.pack("<f" if kind == "float32" else "<d", value)
        if kind == "bool":
            return bytes([chance.getrandbits(1)])
        if kind in {"uint64", "int64"} and chance.random() < 0.3:
            return struct.pack("<Q" if kind == "uint64" else "<q", chance.choice(_EDGES[kind]))
        # Both halves of the ranges of int8, byte and uint8; whole seconds within an hour for a time.
        return bytes([chance.getrandbits(8)]) + bytes(SIZES[kind] - 1)

    def text(self, _name: str) -> bytes:
        return self._random.choice(_WORDS)

    def length(self, name: str) -> int:
        return self._lengths.get(name, self._random.randrange(5))


class Maker:
    """The messages of one publisher, in order: equal for equal seeds, except for the headers."""

    def __init__(self, topic: Topic, seed: int) -> None:
        self._topic, self._message = topic, topic.message
        self._values = Values(seed, topic.lengths)
        # The header makes a message unique; the rest of it may repeat.
        again = self._message.stamped and topic.rate_hz > 20
        self._bodies = [self._body() for _ in range(97)] if again else []

    def made(self, n: int, header: bytes) -> bytes:
        body = self._bodies[n % len(self._bodies)] if self._bodies else self._body()
        return header + body if self._message.stamped else body

    def _body(self) -> bytes:
        headed = b"" if self._message.stamped else None
        return serialize(self._message, self._values, headed=headed)
