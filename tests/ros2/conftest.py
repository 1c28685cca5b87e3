"""A real ROS 2: publishers, listeners and the agent, each in a process of its own, in a domain of their own.

A machine without ROS 2 skips these tests, also under REQUIRE_ALL=1: no package registry has it.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from testkit.ros2 import ABSENT, Domain, Ros2, Ros2Error, find
from tests.ros import process
from tests.ros.conftest import downlink
from tests.ros.process import Process

SCRIPTS = Path(__file__).resolve().parent / "nodes"
COLLECTOR = Path(__file__).resolve().parents[1] / "ros" / "nodes" / "collector.py"


@pytest.fixture(scope="session")
def ros2() -> Ros2:
    """The machine's ROS 2, with a Python that has rclpy and the agent's requirements."""
    try:
        return find()
    except Ros2Error as error:
        if str(error) == ABSENT:
            pytest.skip(ABSENT)
        raise


class Graph(process.Graph):
    """A ROS 2 graph of its own: a domain that only this machine sees, and the processes in it."""

    ros = 2

    def __init__(self, ros2: Ros2, folder: Path) -> None:
        self.ros2, self.domain = ros2, Domain()
        own = {"ROS_LOG_DIR": str(folder), "ROS_HOME": str(folder)}
        super().__init__(ros2.python, folder, {**ros2.alone(self.domain.number), **own}, SCRIPTS)
        self._numbers = itertools.count()

    def publisher(self, name: str, topic: str, kind: str, **options: Any) -> Process:
        """Run publisher.py; ``options`` are those of its command line, True for a flag."""
        arguments: list[object] = []
        for option, value in options.items():
            flag = f"--{option.replace('_', '-')}"
            arguments += [flag] if value is True else [flag, value]
        return self.run("publisher.py", name, topic, kind, *arguments)

    def downlink(self, settings: object, *arguments: str) -> Process:
        """Run the agent's downlink alone; see tests/ros/nodes/downlinks.py."""
        return self.start(downlink(self.python, self.folder, settings, "--ros2", *arguments))

    def collector(self, topics: dict[str, Any], **settings: Any) -> Process:
        """Run the agent's source alone, whose lines are samples; see tests/ros/nodes/collector.py."""
        # A file of its own: an earlier collector may be reading the other.
        file = self.folder / f"source{next(self._numbers)}.json"
        file.write_text(json.dumps({"type": "ros2", "topics": topics, **settings}))
        return self.start([self.python, str(COLLECTOR), str(file)])

    def command(self, *arguments: object) -> Process:
        """Run the command ``ros2``."""
        return self.start(["ros2", *map(str, arguments)])

    def stop(self) -> None:
        super().stop()
        self.domain.close()


@pytest.fixture
def graph(ros2: Ros2, tmp_path: Path) -> Iterator[Graph]:
    found = Graph(ros2, tmp_path)
    try:
        yield found
    finally:
        found.stop()
