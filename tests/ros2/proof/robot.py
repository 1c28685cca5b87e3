"""A ROS 2 robot of many topics: what F1TENTH cars and others publish, and a lab's own odd types.

`proof_publisher.py` publishes them by rclpy, in processes of their own; the command `ros2 topic pub` some.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple


class Topic(NamedTuple):
    """A topic of one publisher. ``lengths`` has sequence lengths by field name; other sequences have up to
    four elements, a different number in each message. One without a rate is published once.
    """

    name: str
    kind: str
    rate_hz: float
    lengths: Mapping[str, int] = {}
    latched: bool = False
    best_effort: bool = False

    @property
    def settings(self) -> dict[str, str]:
        """How the agent records it, besides its stream and time."""
        return {"large": "upload"} if self.lengths.get("data", 0) > 50_000 else {}

    @property
    def stream(self) -> str:
        return self.name[1:].replace("/", "_")


class Command(NamedTuple):
    """A topic of `ros2 topic pub`, whose messages are all equal."""

    name: str
    kind: str
    rate_hz: float
    values: str
    options: tuple[str, ...] = ()
    settings: Mapping[str, str] = {}

    @property
    def latched(self) -> bool:
        return "transient_local" in self.options

    @property
    def stream(self) -> str:
        return self.name[1:].replace("/", "_")


# The package that package.py builds.
LAB = "lab_msgs"
_JOINTS = Topic("/joint_states", "sensor_msgs/msg/JointState", 50, dict.fromkeys(("name", "position"), 6))
# Node -> its topics: two publishers of a topic are two nodes.
NODES: dict[str, list[Topic]] = {
    "base": [
        Topic("/sensors/core", "vesc_msgs/msg/VescStateStamped", 50),
        Topic("/drive", "ackermann_msgs/msg/AckermannDriveStamped", 40),
        Topic("/odom", "nav_msgs/msg/Odometry", 30),
        Topic("/joy", "sensor_msgs/msg/Joy", 20),
        Topic("/tf", "tf2_msgs/msg/TFMessage", 40),
        Topic("/tf_static", "tf2_msgs/msg/TFMessage", 0, {"transforms": 5}, latched=True),
        Topic("/map", "nav_msgs/msg/OccupancyGrid", 0, {"data": 100 * 100}, latched=True),
        Topic("/plan", "nav_msgs/msg/Path", 2),
        Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 2),
        Topic("/clock", "rosgraph_msgs/msg/Clock", 20),
        Topic("/heartbeat", "std_msgs/msg/Empty", 5),
        Topic("/note", "std_msgs/msg/String", 5),
        Topic("/ticks", "std_msgs/msg/UInt64MultiArray", 10),
        Topic("/raw", "std_msgs/msg/ByteMultiArray", 10),
        Topic("/battery", "sensor_msgs/msg/BatteryState", 1),
        Topic("/markers", "visualization_msgs/msg/MarkerArray", 2),
        Topic("/odd/arrays", "test_msgs/msg/Arrays", 5),
        Topic("/odd/bounded", "test_msgs/msg/BoundedSequences", 5),
        Topic("/odd/nested", "test_msgs/msg/MultiNested", 2),
        Topic("/odd/wide", "test_msgs/msg/WStrings", 5),
        Topic("/lab/envelope", f"{LAB}/msg/Envelope", 10),
        Topic("/lab/limits", f"{LAB}/msg/Limits", 10),
        Topic("/lab/empties", f"{LAB}/msg/Empties", 5),
        _JOINTS,
    ],
    "sensors": [
        Topic("/scan", "sensor_msgs/msg/LaserScan", 10, {"ranges": 720, "intensities": 0}, best_effort=True),
        Topic("/points", "sensor_msgs/msg/PointCloud2", 5, {"data": 100_000}, best_effort=True),
        Topic("/camera/compressed", "sensor_msgs/msg/CompressedImage", 5, {"data": 40_000}, best_effort=True),
        Topic("/gps", "sensor_msgs/msg/NavSatFix", 5, best_effort=True),
    ],
    "imu": [Topic("/imu", "sensor_msgs/msg/Imu", 200)],
    # It is started again in the middle of the drive.
    "rear": [
        _JOINTS._replace(rate_hz=20),
        Topic("/rear/scan", "sensor_msgs/msg/LaserScan", 5, {"ranges": 90}),
    ],
}
TOPICS = {topic.name: topic for topics in NODES.values() for topic in topics}
_KEPT = ("--qos-durability", "transient_local", "--qos-reliability", "reliable")
COMMANDS = {
    command.name: command
    for command in (
        Command("/cmd_vel", "geometry_msgs/msg/Twist", 10, "{linear: {x: 1.5}, angular: {z: -0.25}}"),
        Command("/greeting", "std_msgs/msg/String", 5, "{data: 'Grüße, 世界 🏎!!!'}"),
        Command("/mode", "std_msgs/msg/UInt32", 1, "{data: 7}", _KEPT),
    )
}


def everything() -> Iterator[Topic | Command]:
    """Every topic once."""
    yield from TOPICS.values()
    yield from COMMANDS.values()
