"""Two robots with a ROS graph each share poses and receive commands through the cloud.

tests/ros2/test_two_robots.py runs it in ROS 2.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from iort_contract.messages.commands import Command, encode_command
from iort_contract.topics import CMD, build_topic
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from tests.local.conftest import bundle, embedded, iort  # noqa: F401 - fixtures
from tests.ros.conftest import Graph
from tests.ros.process import Process
from tests.ros.test_downlink import POSE_TYPE
from tests.unit.agent.control.downlink_rig import POSE

if TYPE_CHECKING:
    from tests.ros.test_downlink import AnyGraph

SPEED_TYPE = {1: "std_msgs/Float64", 2: "std_msgs/msg/Float64"}
# Between the poses of the robots, which count up.
FAR = 1_000_000
DRIVE = {
    "topic": "/speed",
    "max_age_s": 60,
    "motion": {"lease_s": 2, "stop": {"data": 0.0}},
}


@pytest.fixture
def graphs(ros_python: str, tmp_path: Path) -> Iterator[list[Graph]]:
    found = []
    try:
        for name in ("a", "b"):
            (tmp_path / name).mkdir()
            graph = Graph(ros_python, tmp_path / name)
            found.append(graph)
            graph.start_master()
        yield found
    finally:
        for graph in found:
            graph.stop()


def publish_poses(graph: AnyGraph, start: int) -> None:
    """Poses whose x counts up from a start."""
    if isinstance(graph, Graph):
        text = graph.folder / "pose.msg"
        text.write_text(POSE)
        graph.run(
            "publisher.py", "pub", "/pose", POSE_TYPE[1], text, "--field", "pose.position.x", "--start", start
        )
    else:
        graph.publisher("pub", "/pose", POSE_TYPE[2], field="pose.position.x", start=start)


def some(listener: Process) -> bool:
    return len(messages(listener)) > 5


def messages(listener: Process) -> list[Any]:
    return [json.loads(line)[1] for line in list(listener.lines) if line.startswith("[")]


def test_two_robots_exchange_poses_and_receive_commands(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    bundle: Callable[..., robots.Bundle],  # noqa: F811 - the fixture
    iort: Callable[..., Any],  # noqa: F811 - the fixture
    graphs: list[AnyGraph],
) -> None:
    ros = graphs[0].ros
    pose_type, speed_type = POSE_TYPE[ros], SPEED_TYPE[ros]
    settings = {
        "sources": [{"type": f"ros{ros}", "topics": {"/pose": {"stream": "pose", "time": "header"}}}],
        "share": {"/pose": {"name": "pose", "rate_hz": 10}},
        "downlink": {
            "cmd": {"drive": {**DRIVE, "type": speed_type}},
            "fleet": {"pose": {"topic": "/fleet/{robot}/pose", "type": pose_type}},
        },
    }
    cars = [bundle(name, **settings) for name in ("-a", "-b")]
    agents = [
        graph.module("iort_agent.cli", "run", "--config", car.config, "--drain-s", 10)
        for graph, car in zip(graphs, cars, strict=True)
    ]
    for i, graph in enumerate(graphs):
        publish_poses(graph, FAR * (i + 1))
    listeners = [
        graph.listener("map", f"/fleet/{other.robot.replace('-', '_')}/pose", pose_type)
        for graph, other in zip(graphs, reversed(cars), strict=True)
    ]
    for listener, agent, other in zip(listeners, agents, (2, 1), strict=True):
        agent.until_said("connected to")
        listener.until(functools.partial(some, listener), "poses" + "\n".join(agent.errors))
        assert {m["pose"]["position"]["x"] // FAR for m in messages(listener)} == {other}

    # The operator drives one of them, then stops sending.
    driver = graphs[0].listener("driver", "/speed", speed_type)
    driver.until(lambda: "connected" in driver.lines, "connection")
    operator, started_us, seq = embedded.cloud.client("iot-data"), time.time_ns() // 1000, 0
    topic = build_topic(CMD, cars[0].robot, "drive", embedded.namespace)
    while 1.5 not in [m["data"] for m in messages(driver)]:
        command = Command("feedbeef", started_us, seq, time.time_ns() // 1000, 60_000, {"data": 1.5}, 2000)
        operator.publish(topic=topic, qos=1, payload=encode_command(command))
        seq += 1
        assert seq < 1000, "\n".join(agents[0].errors)
        time.sleep(0.1)  # an operator's joystick
    driver.until(lambda: messages(driver)[-1]["data"] == 0, "stop")

    # `iort send` also reports the command's result.
    sent = iort("send", cars[0].robot, "drive", '{"data": 2.5}', "--lease-ms", "2000", "--valid-ms", "60000",
                "--seconds", "60")  # fmt: skip
    assert sent.exit_code == 0, sent.output + str(sent.exception) + "\n".join(agents[0].errors)
    assert "has accepted drive" in sent.output
    driver.until(lambda: 2.5 in [m["data"] for m in messages(driver)], "command")
    for message, said in (
        ('{"data": "fast"}', "data: must be a number, got 'fast'"),
        ('{"data": 1}', "without lease"),
    ):
        refused = iort("send", cars[0].robot, "drive", message, "--valid-ms", "60000", "--seconds", "60")
        assert refused.exit_code == 1
        assert said in str(refused.exception)

    assert [agent.terminate() for agent in agents] == [0, 0]
    for agent in agents:
        log = "\n".join(agent.errors)
        assert "Traceback" not in log, log
