"""`iort-agent init` in a real graph of ROS 2, and the agent that runs with what it wrote."""

from __future__ import annotations

from pathlib import Path

import yaml

from iort_agent.config import load_config
from testkit.waiting import until
from tests.ros.agents import Agent, configuration
from tests.ros2.conftest import Graph

TOPICS = {
    "/lab/odom": {"stream": "lab-odom", "time": "header"},
    "/map_name": {"stream": "map_name", "time": "arrival"},
    "/sensors/core": {"stream": "vesc", "time": "header"},
    "/tf": {"stream": "tf", "time": "arrival"},
}


def test_init_writes_what_the_agent_then_records(graph: Graph, tmp_path: Path) -> None:
    config = configuration(tmp_path, {"type": "sim"})
    graph.publisher("core", "/sensors/core", "vesc_msgs/msg/VescStateStamped", at_once=True)
    graph.publisher(
        "wheels", "odom", "nav_msgs/msg/Odometry", namespace="/lab", best_effort=True, at_once=True
    )
    graph.publisher("tf", "/tf", "tf2_msgs/msg/TFMessage", values="{transforms: [{}]}", at_once=True)
    graph.publisher("map", "/map_name", "std_msgs/msg/String", latch=True, rate=0.01, at_once=True)
    pixels = f"{{data: {[0] * 20_000}}}"
    graph.publisher("camera", "/image", "sensor_msgs/msg/CompressedImage", values=pixels, at_once=True)
    process = graph.module("iort_agent.cli", "init", "--out", config, "--listen-s", 8)
    process.wait()
    rows = {line.split()[0]: line for line in process.lines}
    assert "- large: --topic /image" in rows["/image"], process.lines
    assert "- ROS' own" in rows["/rosout"]
    assert "sensor_msgs/msg/CompressedImage" in rows["/image"]
    written = tmp_path / "car.new.yaml"
    assert yaml.safe_load(written.read_text())["sources"] == [{"type": "ros2", "topics": TOPICS}]
    load_config(written)
    written.replace(config)
    agent = Agent(graph.module("iort_agent.cli", "run", "--config", config, "--drain-s", 0), tmp_path)
    until(lambda: all(agent.samples(topic["stream"]) > 0 for topic in TOPICS.values()), within_s=60)
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)
