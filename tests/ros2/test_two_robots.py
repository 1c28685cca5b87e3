"""Two robots with a ROS 2 graph each: what tests/ros/test_two_robots.py holds over ROS 1 holds here, too."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.ros2 import Ros2
from tests.local.conftest import bundle, embedded, iort  # noqa: F401 - fixtures
from tests.ros.test_two_robots import (  # noqa: F401 - collected here, with the graphs below
    test_two_robots_exchange_poses_and_receive_commands,
)
from tests.ros2.conftest import Graph


@pytest.fixture
def graphs(ros2: Ros2, tmp_path: Path) -> Iterator[list[Graph]]:
    """Two domains, which do not see each other."""
    found = []
    try:
        for name in ("a", "b"):
            (tmp_path / name).mkdir()
            found.append(Graph(ros2, tmp_path / name))
        yield found
    finally:
        for graph in found:
            graph.stop()
