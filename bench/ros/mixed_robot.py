"""The mixed robot of the bench: its topics, their types as text, and values like those of real sensors.

Types come from the text, as every subscriber gets them, so that only Debian's rospy has to be installed.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from testkit import ros1_types
from testkit.ros1_types import MESSAGES

_RANGES, _MAP_CELLS = 720, 200
_ARM, _GRIPPER = tuple(f"joint_{i}" for i in range(1, 7)), ("finger_left", "finger_right")
_FRAMES = (("odom", "base_link"), ("base_link", "laser"))
_noise = random.Random(1).random  # noqa: S311 - a sensor's noise, no secret
HEADER, ARRIVAL = "header", "arrival"
# Classes of a topic's type and its parts by name.
Classes = Mapping[str, Any]


@dataclass(frozen=True)
class Topic:
    """A topic of one node. ``fill`` sets the fields of a message, except for the header.

    A rate of 0 is one message, latched.
    """

    name: str
    stream: str
    kind: str
    rate_hz: int
    fill: Callable[[Any, Classes, int], None]
    frame: str = ""

    @property
    def definition(self) -> str:
        """The text of the type and of its parts, as a publisher sends it."""
        return MESSAGES[self.kind].definition

    @property
    def time(self) -> str:
        """Where the agent takes a sample's time from."""
        return HEADER if MESSAGES[self.kind].stamped else ARRIVAL


def _vesc(message: Any, _: Classes, i: int) -> None:
    for name, value in zip(ros1_types.FIELDS, ros1_types.values(i), strict=True):
        setattr(message.state, name, value)


def _imu(message: Any, _: Classes, i: int) -> None:
    # Whole steps of 16-bit converters: 2 g and 250 degrees a second.
    turn, pull = message.angular_velocity, message.linear_acceleration
    turn.x, turn.y, turn.z = (round(40 * _noise() - 20) * math.radians(250) / 32768 for _ in range(3))
    turn.z += round(9000 * math.sin(i / 700)) * math.radians(250) / 32768
    pull.x, pull.y, pull.z = (round(200 * _noise() + at) * 2 * 9.80665 / 32768 for at in (-100, -100, 16284))
    message.orientation.w, message.orientation.z = math.cos(i / 3000), math.sin(i / 3000)
    message.orientation_covariance = [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01]


def _joints(names: tuple[str, ...]) -> Callable[[Any, Classes, int], None]:
    def fill(message: Any, _: Classes, i: int) -> None:
        message.name = list(names)
        # Steps of an encoder of 4,096 a turn.
        message.position = [
            round(900 * math.sin(i / 80 + joint)) * math.tau / 4096 for joint in range(len(names))
        ]
        message.velocity = [round(560 * math.cos(i / 80 + joint)) / 1000 for joint in range(len(names))]

    return fill


def _tf(message: Any, classes: Classes, i: int) -> None:
    # Every other message has the laser's transform too, as where two nodes publish.
    message.transforms = [classes["geometry_msgs/TransformStamped"]() for _ in range(1 + i % 2)]
    for transform, (parent, child) in zip(message.transforms, _FRAMES, strict=False):
        transform.header.frame_id, transform.child_frame_id = parent, child
        transform.header.seq = i
        transform.transform.rotation.w = 1.0
    moved = message.transforms[0].transform
    moved.translation.x, moved.translation.y = 5 * math.cos(i / 500), 5 * math.sin(i / 500)
    moved.rotation.z, moved.rotation.w = math.sin(i / 1000), math.cos(i / 1000)


def _scan(message: Any, _: Classes, i: int) -> None:
    message.angle_min, message.angle_max = -math.pi, math.pi
    message.angle_increment, message.scan_time = math.tau / _RANGES, 0.05
    message.range_min, message.range_max = 0.1, 12.0
    # A room to the millimetre, with the sensor's noise.
    message.ranges = [
        round(4000 + 1500 * math.cos((k + i) / 57) + 12 * _noise()) / 1000 for k in range(_RANGES)
    ]


def _odom(message: Any, _: Classes, i: int) -> None:
    message.child_frame_id = "base_link"
    pose, twist = message.pose.pose, message.twist.twist
    pose.position.x, pose.position.y = 5 * math.cos(i / 500), 5 * math.sin(i / 500)
    pose.orientation.z, pose.orientation.w = math.sin(i / 1000), math.cos(i / 1000)
    twist.linear.x, twist.angular.z = 0.5 + round(20 * _noise()) / 1000, 0.1
    message.pose.covariance = [0.2 if k % 7 == 0 else 0.0 for k in range(36)]


def _diagnostics(message: Any, classes: Classes, i: int) -> None:
    message.status = []
    for name in ("motor", "battery", "laser"):
        status = classes["diagnostic_msgs/DiagnosticStatus"]()
        status.name, status.hardware_id = f"base: {name}", f"{name}-1"
        status.level, status.message = i % 11 == 0, "OK" if i % 11 else "late by 12 ms"
        value = classes["diagnostic_msgs/KeyValue"]()
        value.key, value.value = "temperature", f"{31 + i % 7}.5 C"
        status.values = [value]
        message.status.append(status)


def _contact(message: Any, _: Classes, i: int) -> None:
    message.grip.header.seq, message.grip.header.frame_id = i, "finger_left"
    message.grip.force, message.grip.touching = (i % 50) / 10, i % 50 > 10
    message.label = "cup"


def _map(message: Any, _: Classes, __: int) -> None:
    message.info.resolution, message.info.width, message.info.height = 0.05, _MAP_CELLS, _MAP_CELLS
    message.info.origin.orientation.w = 1.0
    # Known within a circle, with a wall around it.
    half = _MAP_CELLS // 2
    far = [math.hypot(k % _MAP_CELLS - half, k // _MAP_CELLS - half) for k in range(_MAP_CELLS**2)]
    message.data = [0 if away < half - 8 else 100 if away < half - 5 else -1 for away in far]


def _nothing(_: Any, __: Classes, ___: int) -> None:
    pass


_CORE = Topic("/sensors/core", "vesc", ros1_types.TYPE, 50, _vesc, "base_link")
# The topics of each node of the mixed robot.
MIXED: dict[str, tuple[Topic, ...]] = {
    "base": (
        _CORE,
        Topic("/imu", "imu", "sensor_msgs/Imu", 1000, _imu, "imu"),
        Topic("/tf", "tf", "tf2_msgs/TFMessage", 50, _tf),
        Topic("/joint_states", "joints", "sensor_msgs/JointState", 50, _joints(_ARM)),
        Topic("/scan", "scan", "sensor_msgs/LaserScan", 20, _scan, "laser"),
        Topic("/odom", "odom", "nav_msgs/Odometry", 50, _odom, "odom"),
        Topic("/diagnostics", "diagnostics", "diagnostic_msgs/DiagnosticArray", 1, _diagnostics),
        Topic("/tick", "tick", "std_msgs/Empty", 5, _nothing),
        Topic("/contact", "contact", "lab_msgs/LabelledContact", 10, _contact),
        Topic("/map", "map", "nav_msgs/OccupancyGrid", 0, _map, "map"),
    ),
    "gripper": (Topic("/joint_states", "joints", "sensor_msgs/JointState", 50, _joints(_GRIPPER)),),
}
# Every node of the bench: `CORE` is a robot of one topic, which is measured at several rates.
CORE = "core"
NODES = {**MIXED, CORE: (_CORE,)}


def topics() -> dict[str, Topic]:
    """Return each topic of the mixed robot once, by name."""
    return {topic.name: topic for node in MIXED.values() for topic in node}
