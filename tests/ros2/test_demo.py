"""`make demo ROS2=1`: a simulated car in a ROS 2 graph, the agent in it, and every message in the cloud."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.ros.process import Process
from tests.ros2.conftest import Graph


def test_the_demo_records_what_a_car_in_a_ros2_graph_publishes(graph: Graph, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    arguments = ["--folder", tmp_path / "local", "--ros2", "--duration", 5, "--report", report]
    demo = graph.module("local.demo", *arguments)
    assert demo.ended() == 0, "\n".join(demo.lines[-25:] + demo.errors[-25:])
    figures = json.loads(report.read_text())
    # 50 states of the motor controller a second, if its type is installed, and 20 positions.
    assert figures["samples_sent"] == 5 * (70 if graph.ros2.has("vesc_msgs") else 20)
    assert figures["samples_stored"] == figures["samples_summarized"] == figures["samples_sent"]
    assert figures["live_received"] > 0


def messages(listener: Process) -> list[dict[str, Any]]:
    return [json.loads(line)[1] for line in list(listener.lines) if line[0] == "["]


def test_the_simulated_car_obeys_and_says_what_it_has_published(graph: Graph) -> None:
    settings = {"rate_hz": 50, "duration_s": 20, "pose": {"rate_hz": 20}}
    car = graph.module("local.ros2_car", "--settings", json.dumps(settings))
    heard = {"/odom": graph.listener("ears", "/odom", "nav_msgs/msg/Odometry")}
    if graph.ros2.has("vesc_msgs"):
        heard["/sensors/core"] = graph.listener("motor", "/sensors/core", "vesc_msgs/msg/VescStateStamped")
    twist = '{"linear": {"x": -1.0}}'
    driver = graph.publisher("driver", "/cmd_vel", "geometry_msgs/msg/Twist", values=twist, rate=10)

    def reverses() -> bool:
        return any(
            message["twist"]["twist"]["linear"]["x"] < -0.9 for message in messages(heard["/odom"])[-1:]
        )

    heard["/odom"].until(reverses, "the car to reverse")
    assert driver.quit()
    car.wait()
    sent = json.loads(car.lines[-1])
    assert sent == {topic: len(messages(listener)) for topic, listener in heard.items()}
    assert sent["/odom"] == 20 * 20
