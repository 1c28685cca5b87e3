"""A ROS 2 node has the recorder keep what happens: what tests/ros/test_keep.py holds over ROS 1 holds."""

import json
import struct
from pathlib import Path

import pytest

from iort_contract.ros.message import RosMessage, RosType
from tests.ros.test_keep import (  # noqa: F401 - collected here, with the graph of this folder
    test_a_program_keeps_by_service_and_topic_and_the_map_is_there,
)
from tests.ros2.conftest import Graph
from tests.unit.agent.recorder.test_latched import cut_of
from tests.unit.agent.recorder.test_ring import Desk

KIND = "geometry_msgs/msg/PointStamped"


@pytest.fixture
def published(graph: Graph) -> None:
    """A topic that goes on, and one that is latched."""
    graph.publisher("wheel", "/wheel", KIND, field="point.x", rate=50)
    graph.publisher("map", "/map", KIND, field="point.x", latch=True, at_once=True, count=1)


def test_a_player_gives_what_was_in_force_to_who_subscribes_later(graph: Graph, tmp_path: Path) -> None:
    if not (graph.ros2.has("ros2bag") and graph.ros2.has("rosbag2_storage_mcap")):
        pytest.skip("ros2 bag, or its storage mcap, is not installed")
    desk = Desk(tmp_path / "ring")
    for topic, publisher in (("/map", ""), ("/point", None)):
        kind = RosType(topic, "geometry_msgs/msg/Point", "RIHS01_1", "float64 x\nfloat64 y\nfloat64 z")
        data = b"\0\1\0\0" + struct.pack("<3d", 7, 8, 9)
        desk.emit(topic[1:], desk.clock.now_us(), RosMessage(data, kind, latched_by=publisher))
        desk.pass_s(3)
    now_us = desk.ring.now_us()
    assert [*cut_of(desk, now_us - 4_000_000, now_us).messages] == ["/map", "/point"]
    desk.ring.close()
    path = (tmp_path / "ring.mcap.part").rename(tmp_path / "incident.mcap")
    player = graph.command("bag", "play", "--loop", path)
    # It asks for what was published before, and no publisher that does not keep it is connected.
    late = graph.run("listener.py", "late", "/map", "geometry_msgs/msg/Point", "--latched")
    message = late.until(lambda: next((line for line in late.lines if line[0] == "["), None), "the map")
    assert json.loads(message)[1] == {"x": 7.0, "y": 8.0, "z": 9.0}
    player.kill()
