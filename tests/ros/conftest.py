"""A real ROS 1: a master, publishers and the agent, each in a process of its own.

The agent's Python needs rospy: IORT_ROS_PYTHON names one; otherwise build/ros-venv is made once from
Debian's Python.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from testkit.ros import SYSTEM_PYTHON, RosGraph, python_with_rospy
from tests.ros import process
from tests.ros.process import Process

SCRIPTS = Path(__file__).resolve().parent / "nodes"
PACKAGES = "python3-rospy python3-rosmaster python3-std-msgs python3-geometry-msgs"


@pytest.fixture(scope="session")
def ros_python() -> str:
    """A Python with rospy and the agent's requirements."""
    given = os.environ.get("IORT_ROS_PYTHON")
    python = given or SYSTEM_PYTHON
    if not Path(python).is_file() or shutil.which("rosmaster") is None:
        pytest.skip(f"ROS 1 is not installed: apt install {PACKAGES}")
    modules = "import rospy, rosmaster, genpy, std_msgs.msg, geometry_msgs.msg"
    tried = subprocess.run([python, "-c", modules], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f"{python} cannot import ROS 1 (apt install {PACKAGES}): {tried.stderr.splitlines()[-1]}")
    return python_with_rospy()


def downlink(python: str, folder: Path, settings: object, *arguments: str) -> list[str]:
    """The command that runs an agent's downlink alone."""
    file = folder / "downlink.json"
    file.write_text(json.dumps(settings))
    return [python, str(SCRIPTS / "downlinks.py"), str(file), *arguments]


class Graph(process.Graph):
    """A ROS graph of its own: master, environment, and the processes in it."""

    ros = 1

    def __init__(self, python: str, folder: Path) -> None:
        self._ros = RosGraph(python, folder)
        super().__init__(python, folder, self._ros.environment, SCRIPTS)
        self.master: Process

    def start_master(self) -> None:
        self.master = self.start(self._ros.master)
        self._ros.await_master()

    def downlink(self, settings: object, *arguments: str) -> Process:
        """Run the agent's downlink alone; see nodes/downlinks.py."""
        return self.start(downlink(self.python, self.folder, settings, *arguments))

    def parameter(self, name: str, value: Any) -> None:
        with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"], allow_none=True) as proxy:
            proxy.setParam("/test", name, value)


@pytest.fixture
def graph(ros_python: str, tmp_path: Path) -> Iterator[Graph]:
    found = Graph(ros_python, tmp_path)
    try:
        found.start_master()
        yield found
    finally:
        found.stop()
