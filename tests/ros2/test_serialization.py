"""The agent reads and writes messages as the middlewares do: of all installed types, and of a lab's own."""

from __future__ import annotations

from pathlib import Path

from testkit.ros2 import Ros2
from tests.ros2.conftest import Graph
from tests.ros2.proof import package
from tests.ros2.proof.robot import LAB

SEED, MESSAGES = 20, 6
# Every message that the robot of a lab would have, and with them all others that are installed.
WANTED = {"sensor_msgs/msg/Imu", "std_msgs/msg/Empty", "tf2_msgs/msg/TFMessage"}
OWN = {f"{LAB}/msg/{name}" for name in package.MESSAGES}


def compared(graph: Graph) -> list[str]:
    """The lines of the comparison with the graph's middleware."""
    process = graph.module("tests.ros2.nodes.serialization", SEED, MESSAGES)
    process.until(lambda: any(line.startswith("compared ") for line in process.lines), "end")
    return process.lines


def test_messages_of_every_type_are_read_and_written(ros2: Ros2, tmp_path: Path) -> None:
    ros2 = package.built(ros2) or ros2
    # The dynamic one writes as the other of Fast DDS does.
    for middleware in set(ros2.middlewares()) - {"rmw_fastrtps_dynamic_cpp"}:
        graph = Graph(ros2, tmp_path)
        graph.environment["RMW_IMPLEMENTATION"] = middleware
        try:
            *differences, last = compared(graph)
        finally:
            graph.stop()
        assert not differences, middleware
        assert WANTED | (OWN if ros2.has(LAB) else set()) <= set(last.split())
