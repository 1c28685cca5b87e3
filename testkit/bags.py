"""A recording made by a script, of any size: a car with a VESC, odometry, an IMU, a laser scanner and
transforms, as ROS 1 or ROS 2 record it. Its values follow from the number of the message, so a reader can
compute them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags import rosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.recordings.rosbag import VESC_STATE_ROS2, VESC_TYPE

# When the recording starts, unless it is told, in nanoseconds.
START_NS = 1_600_000_000_000_000_000
# What a second of the recording takes, about.
BYTES_A_SECOND = 480_000
BEAMS = 1081
_WHOLE = {"displacement", "distance_traveled", "fault_code", "controller_id"}


class Topic(NamedTuple):
    """A topic, its type, its rate, and the message of a number at a time."""

    name: str
    kind: str
    hz: int
    make: Callable[[Any, int, Any], Any]


def speed(i: int) -> float:
    """The VESC's speed in ERPM in message ``i``."""
    return float(3000 + 10 * (i % 500))


def voltage(i: int) -> float:
    """The battery's voltage in V in message ``i``."""
    return round(12.6 - (i % 36_000) * 5e-5, 4)


def _state(types: Any, i: int, header: Any) -> Any:
    names = [line.split()[1] for line in VESC_STATE_ROS2.split("\n") if line]
    values: dict[str, Any] = {name: i % 100 if name in _WHOLE else (i % 200) / 8 for name in names}
    values.update(speed=speed(i), voltage_input=voltage(i), fault_code=0, controller_id=7)
    return types[VESC_TYPE](header=header, state=types["vesc_msgs/msg/VescState"](**values))


def _vector(types: Any, kind: str, *values: float) -> Any:
    return types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", values, strict=False)))


def _odometry(types: Any, i: int, header: Any) -> Any:
    angle, covariance = i / 500, np.zeros(36)
    pose = types["geometry_msgs/msg/Pose"](
        position=_vector(types, "Point", 8 * math.cos(angle), 3 * math.sin(angle), 0.0),
        orientation=_vector(types, "Quaternion", 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)),
    )
    twist = types["geometry_msgs/msg/Twist"](
        linear=_vector(types, "Vector3", 1.5, 0.0, 0.0), angular=_vector(types, "Vector3", 0.0, 0.0, 0.1)
    )
    return types["nav_msgs/msg/Odometry"](
        header=header,
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
    )


def _imu(types: Any, i: int, header: Any) -> Any:
    covariance = np.zeros(9)
    return types["sensor_msgs/msg/Imu"](
        header=header,
        orientation=_vector(types, "Quaternion", 0.0, 0.0, 0.0, 1.0),
        orientation_covariance=covariance,
        angular_velocity=_vector(types, "Vector3", 0.001 * (i % 7), 0.0, math.sin(i / 40)),
        angular_velocity_covariance=covariance,
        linear_acceleration=_vector(types, "Vector3", math.cos(i / 60), 0.02 * (i % 11), 9.81),
        linear_acceleration_covariance=covariance,
    )


_ANGLES = np.linspace(-2.35, 2.35, BEAMS)


def _scan(types: Any, i: int, header: Any) -> Any:
    noise = np.random.default_rng(i).normal(0, 0.01, BEAMS)
    walls = 2 + np.abs(np.sin(_ANGLES * 2 + i / 300)) * 4
    # A scanner measures whole millimeters.
    ranges = np.round(walls + noise, 3).astype(np.float32)
    return types["sensor_msgs/msg/LaserScan"](
        header=header,
        angle_min=-2.35,
        angle_max=2.35,
        angle_increment=0.00435,
        time_increment=1.7e-5,
        scan_time=0.025,
        range_min=0.02,
        range_max=30.0,
        ranges=ranges,
        intensities=np.round(ranges * 37).astype(np.float32),
    )


def _transforms(types: Any, i: int, header: Any) -> Any:
    def one(child: str, x: float) -> Any:
        transform = types["geometry_msgs/msg/Transform"](
            translation=_vector(types, "Vector3", x, 0.0, 0.2),
            rotation=_vector(types, "Quaternion", 0.0, 0.0, 0.0, 1.0),
        )
        return types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id=child, transform=transform
        )

    # Now and then there is another one.
    children = ["base_link", *(["camera"] if i % 50 == 0 else [])]
    return types["tf2_msgs/msg/TFMessage"](transforms=[one(child, i / 100) for child in children])


TOPICS = (
    Topic("/sensors/core", VESC_TYPE, 50, _state),
    Topic("/odom", "nav_msgs/msg/Odometry", 50, _odometry),
    Topic("/imu/data", "sensor_msgs/msg/Imu", 100, _imu),
    Topic("/scan", "sensor_msgs/msg/LaserScan", 40, _scan),
    Topic("/tf", "tf2_msgs/msg/TFMessage", 50, _transforms),
)
# The streams that a robot makes of the topics.
STREAMS = {"/sensors/core": "vesc", "/odom": "odom", "/imu/data": "imu-data", "/scan": "scan", "/tf": "tf"}


def written(path: Path, kind: str, *, seconds: float, start_ns: int = START_NS) -> int:
    """Write a ``bag``, ``mcap``, ``db3`` or ``mcap of ROS 1``; returns the number of its messages."""
    ros1 = kind in ("bag", "mcap of ROS 1")
    store = _store(ros1=ros1)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    count = 0
    with _writer(path, kind, store) as begin:
        writes = [begin(topic) for topic in TOPICS]
        each = (_messages(n, topic, seconds, start_ns) for n, topic in enumerate(TOPICS))
        for t_ns, n, i in merge(*each):
            sec, nanosec = divmod(t_ns - 2_000_000, 1_000_000_000)
            stamp = store.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
            seq = {"seq": i} if ros1 else {}
            header = store.types["std_msgs/msg/Header"](**seq, stamp=stamp, frame_id="map")
            writes[n](t_ns, bytes(serialize(TOPICS[n].make(store.types, i, header), TOPICS[n].kind)))
            count += 1
    return count


def _messages(n: int, topic: Topic, seconds: float, start_ns: int) -> Iterator[tuple[int, int, int]]:
    return ((start_ns + i * 1_000_000_000 // topic.hz, n, i) for i in range(int(seconds * topic.hz)))


def _store(*, ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    transforms = "geometry_msgs/msg/TransformStamped[] transforms\n"
    store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
    store.register(get_types_from_msg(VESC_STATE_ROS2, "vesc_msgs/msg/VescState"))
    store.register(get_types_from_msg("std_msgs/Header header\nvesc_msgs/msg/VescState state\n", VESC_TYPE))
    return store


Write = Callable[[int, bytes], None]


@contextmanager
def _writer(path: Path, kind: str, store: Any) -> Iterator[Callable[[Topic], Write]]:
    """A function that begins a topic, and returns one that writes its messages."""
    if kind == "mcap of ROS 1":
        with path.open("wb") as file:
            mcap = McapWriter(file)
            mcap.start(profile="ros1")

            def begun(topic: Topic) -> Write:
                text, digest = store.generate_msgdef(topic.kind, ros_version=1)
                name = topic.kind.replace("/msg/", "/")
                schema = mcap.register_schema(name, "ros1msg", text.encode())
                channel = mcap.register_channel(topic.name, "ros1", schema, {"md5sum": digest})
                return lambda t_ns, raw: mcap.add_message(channel, t_ns, raw, t_ns)

            yield begun
            mcap.finish()
        return
    writer: Any = (
        Writer1(path)
        if kind == "bag"
        else rosbag2.Writer(
            path, version=8, storage_plugin=rosbag2.StoragePlugin["MCAP" if kind == "mcap" else "SQLITE3"]
        )
    )
    with writer:

        def begin(topic: Topic) -> Write:
            connection = writer.add_connection(topic.name, topic.kind, typestore=store)
            return lambda t_ns, raw: writer.write(connection, t_ns, raw)

        yield begin
