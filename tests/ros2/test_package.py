"""The agent as a package of a workspace: colcon builds it, `ros2 run` and `ros2 launch` start it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from testkit import ROOT
from testkit.ros2 import Ros2
from testkit.waiting import until
from tests.ros.agents import Agent, configuration
from tests.ros.process import Process
from tests.ros2.conftest import Graph

WAIT_S = 30
PACKAGES = {"iort_contract": "contract", "iort_agent": "device"}
SOURCE = {"type": "ros2", "topics": {"/odom": {"stream": "odom", "time": "header"}}}


@pytest.fixture(scope="module", params=[(), ("--symlink-install",)], ids=["copied", "linked"])
def workspace(ros2: Ros2, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the two packages, built."""
    folder = tmp_path_factory.mktemp("workspace")
    environment = without_checkout(ros2.environment)
    colcon = shutil.which("colcon", path=environment["PATH"])
    if colcon is None:
        pytest.skip("colcon is not on the path: apt install python3-colcon-common-extensions")
    left_out = shutil.ignore_patterns("*.egg-info", "__pycache__", "build")
    for name in PACKAGES.values():
        shutil.copytree(ROOT / name, folder / "src" / name, ignore=left_out)
    command = [colcon, "build", "--executor", "sequential", *request.param]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def without_checkout(environment: dict[str, str]) -> dict[str, str]:
    """The environment with the agent's requirements, and without the agent of this checkout; what the other
    nodes of a test import stands beside the agent's folder, not in it."""
    paths = environment["PYTHONPATH"].split(os.pathsep)
    others = [path for path in paths if path and ROOT not in Path(path).parents]
    path = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
    requirements = sysconfig.get_path("purelib")
    return {**environment, "PATH": path, "PYTHONPATH": os.pathsep.join([*others, requirements])}


@pytest.fixture
def installed(graph: Graph, workspace: Path) -> Iterator[Graph]:
    """A graph in whose environment the workspace is sourced."""
    command = ["bash", "-c", 'source "$0" >&2 && env -0', str(workspace / "install" / "setup.bash")]
    environment = without_checkout(graph.environment)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    pairs = (line.partition("=") for line in done.stdout.split("\0") if line)
    graph.environment = {name: value for name, _, value in pairs}
    yield graph
    # `ros2` leaves what it has started alone.
    for process in graph._processes:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def interrupt(process: Process) -> None:
    """Press Ctrl-C, which the whole group gets."""
    os.killpg(process.pid, signal.SIGINT)
    process.wait()


def odometry(graph: Graph, topic: str = "/odom") -> None:
    publisher = graph.publisher(
        "wheels", topic, "nav_msgs/msg/Odometry", field="pose.pose.position.x", at_once=True
    )
    publisher.until(lambda: "ready" in publisher.lines, "publisher")


def test_ros2_run_starts_the_agent_with_its_parameters(installed: Graph, tmp_path: Path) -> None:
    version = installed.command("run", "iort_agent", "iort-agent", "--version")
    version.wait()
    assert version.lines[0].startswith("iort-agent ")
    config = configuration(tmp_path, SOURCE)
    odometry(installed, "/wheels/odom")
    arguments = ("-p", f"config:={config}", "-r", "/odom:=/wheels/odom", "-r", "__node:=recorder")
    agent = Agent(installed.command("run", "iort_agent", "iort-agent", "--ros-args", *arguments), tmp_path)
    until(lambda: agent.samples("odom") > 5, within_s=WAIT_S)
    assert "/recorder" in nodes(installed)
    interrupt(agent.process)


def test_ros2_launch_starts_the_agent_by_its_arguments(installed: Graph, tmp_path: Path) -> None:
    config = configuration(tmp_path, SOURCE)
    odometry(installed)
    arguments = (f"config:={config}", "node_name:=recorder", "namespace:=lab")
    agent = Agent(installed.command("launch", "iort_agent", "agent.launch.py", *arguments), tmp_path)
    until(lambda: agent.samples("odom") > 5, within_s=WAIT_S)
    assert "/lab/recorder" in nodes(installed)
    interrupt(agent.process)
    assert any("process has finished cleanly" in line for line in agent.process.errors + agent.process.lines)


def test_a_launch_without_a_configuration_names_the_argument(installed: Graph) -> None:
    launch = installed.command("launch", "iort_agent", "agent.launch.py")
    assert launch.ended() != 0
    assert any("config" in line for line in launch.errors + launch.lines)


def nodes(graph: Graph) -> list[str]:
    listed = graph.command("node", "list", "--no-daemon", "--spin-time", "3")
    listed.wait()
    return listed.lines
