"""What `iort-agent check` says of a robot with ROS 2: its graph, and its row in the table."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from iort_agent.config import load_config
from iort_agent.sources import FAIL, OK, WARN
from iort_agent.sources.ros2 import Ros2Config, _others
from iort_agent.verbs.check import rows
from tests.unit.agent.test_agent import config_file

SOURCE = "{type: ros2, topics: {/imu: {stream: imu, time: header}}}"
TRANSPORTS = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")


@pytest.fixture
def jazzy(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A robot's rclpy, with a middleware that may be changed."""
    robot = SimpleNamespace(middleware="rmw_cyclonedds_cpp")
    module = SimpleNamespace(get_rmw_implementation_identifier=lambda: robot.middleware)
    monkeypatch.setitem(sys.modules, "rclpy", module)
    for name, value in (("ROS_DISTRO", "jazzy"), ("ROS_DOMAIN_ID", "7"), ("ROS_LOCALHOST_ONLY", "1")):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    return robot


@pytest.mark.usefixtures("jazzy")
def test_the_graph_that_the_agent_would_join_is_named() -> None:
    (finding,) = Ros2Config(topics=()).check("source 0")
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    text = f"ROS 2 jazzy, {python}, rmw_cyclonedds_cpp, domain 7, ROS_LOCALHOST_ONLY=1"
    assert (finding.level, finding.text) == (OK, text)


def test_a_missing_rclpy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    (finding,) = Ros2Config(topics=()).check("source 0")
    assert finding.level == FAIL
    assert "finds no rclpy" in finding.text


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file away")
def test_memory_of_another_user_is_found(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7410").touch()
    # A node ends while somebody looks.
    (tmp_path / "fastrtps_port7411").symlink_to(tmp_path / "gone")
    assert not _others(tmp_path)
    os.chown(tmp_path / "fastrtps_port7410", 65534, 65534)
    assert _others(tmp_path)


@pytest.mark.parametrize("others", [True, False])
def test_nodes_of_another_user_are_warned_of(
    jazzy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, *, others: bool
) -> None:
    monkeypatch.setattr("iort_agent.sources.ros2._others", lambda: others)
    jazzy.middleware = "rmw_fastrtps_cpp"
    for name in TRANSPORTS:
        monkeypatch.delenv(name, raising=False)
    found = [finding.level for finding in Ros2Config(topics=()).check("source 0")]
    assert found == ([OK, WARN] if others else [OK])
    monkeypatch.setenv(TRANSPORTS[0], "UDPv4")
    assert len([*Ros2Config(topics=()).check("source 0")]) == 1


def test_the_row_has_what_the_running_agent_has_seen(jazzy: SimpleNamespace, tmp_path: Path) -> None:
    config = load_config(config_file(tmp_path, SOURCE))
    (row,) = rows(config, None)
    assert row.text == "| Jazzy | Cyclone DDS | not yet | not yet |"
    jazzy.middleware = "rmw_other"
    running = SimpleNamespace(
        sources=[{"source": "ROS 2", "/imu": {"messages": 1200}, "/odom": {"messages": 0}, "waits": "no"}],
        downlink={"commands": {"drive": {"passed": 3}}, "fleet": {"pose": {"car2": 5}}},
    )
    (row,) = rows(config, running)
    assert row.text == "| Jazzy | rmw_other | 1 topics, 1,200 messages | 3 commands, 5 of peers |"


def test_without_ros_there_is_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [*rows(load_config(config_file(tmp_path, "{type: sim}")), None)] == []
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert [*rows(load_config(config_file(tmp_path, SOURCE)), None)] == []
    monkeypatch.setenv("ROS_DISTRO", "noetic")
    (row,) = rows(load_config(config_file(tmp_path, SOURCE.replace("ros2", "ros1"))), None)
    assert row.text == "| Noetic | TCPROS | not yet | not yet |"
