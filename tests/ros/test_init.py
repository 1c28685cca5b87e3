"""`iort-agent init` in a real graph of ROS 1, and the agent that runs with what it wrote."""

from __future__ import annotations

import xmlrpc.client
from pathlib import Path
from typing import Any

import yaml

from testkit.waiting import until
from tests.ros.agents import Agent, configuration
from tests.ros.conftest import Graph
from tests.ros.test_source import Cars

WHEEL = {"type": "ros1", "topics": {"/wheel": {"stream": "wheel", "time": "header"}}}


def advertised(graph: Graph, topic: str) -> bool:
    with xmlrpc.client.ServerProxy(graph.environment["ROS_MASTER_URI"]) as master:
        known: Any = master.getTopicTypes("/test")
    return any(name == topic for name, _ in known[2])


def test_init_writes_what_the_agent_then_records(graph: Graph, tmp_path: Path) -> None:
    config = configuration(tmp_path, {"type": "sim"})
    Cars(graph).publisher("pub", topic="/wheel")
    until(lambda: advertised(graph, "/wheel"))
    process = graph.module("iort_agent.cli", "init", "--out", config, "--listen-s", 10)
    process.wait()
    (row,) = (line for line in process.lines if line.startswith("/wheel "))
    assert "strange_msgs/Wheel" in row
    written = tmp_path / "car.new.yaml"
    assert yaml.safe_load(written.read_text())["sources"] == [WHEEL]
    written.replace(config)
    agent = Agent(graph.module("iort_agent.cli", "run", "--config", config, "--drain-s", 0), tmp_path)
    until(lambda: agent.samples("wheel") > 5)
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)


def test_init_without_a_master_says_what_is_missing(graph: Graph, tmp_path: Path) -> None:
    graph.master.kill()
    process = graph.module("iort_agent.cli", "init", "--out", tmp_path / "car.yaml", "--listen-s", 1)
    assert process.ended() == 1
    (error,) = (line for line in process.errors if line.startswith("iort-agent: nothing to record"))
    assert "no ROS master at http://" in error
    assert "rclpy" in error
    assert list(tmp_path.glob("*.yaml")) == []
