"""A ROS 2 node has the recorder keep what happens: what tests/ros/test_keep.py holds over ROS 1 holds."""

import pytest

from tests.ros.test_keep import (  # noqa: F401 - collected here, with the graph of this folder
    test_a_program_keeps_by_service_and_topic_and_the_map_is_there,
)
from tests.ros2.conftest import Graph

KIND = "geometry_msgs/msg/PointStamped"


@pytest.fixture
def published(graph: Graph) -> None:
    """A topic that goes on, and one that is latched."""
    graph.publisher("wheel", "/wheel", KIND, field="point.x", rate=50)
    graph.publisher("map", "/map", KIND, field="point.x", latch=True, at_once=True, count=1)
