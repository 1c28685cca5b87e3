"""A program on the robot has the recorder keep what happens, by the service and by the topic of the real
graph; the file begins with the latched message that came to an agent that was killed since.

What takes an `AnyGraph` also runs in ROS 2, from tests/ros2/test_keep.py.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from mcap.reader import make_reader

from iort_agent.recorder.plan import Plan
from testkit.waiting import until
from tests.ros.agents import Agent
from tests.ros.conftest import Graph
from tests.ros.process import WAIT_S
from tests.ros.test_ring import agent_with_ring
from tests.ros.test_source import Cars

if TYPE_CHECKING:
    from tests.ros.test_downlink import AnyGraph

TRIGGER = {"on": "service", "before_s": 0.5, "after_s": 3.0, "cooldown_s": 0.0}
BY = "/iort/ask/keep"


@pytest.fixture
def published(graph: Graph) -> None:
    """A topic that goes on, and one that is latched."""
    cars = Cars(graph)
    cars.publisher("wheel", rate=50)
    cars.publisher("map", topic="/map", count=1, start=7, flags=("--latch",))


def started(graph: AnyGraph, folder: Path) -> Agent:
    """The agent, once it has heard both topics for some seconds."""
    topics = {topic: {"time": "header", "only": "ring"} for topic in ("/wheel", "/map")}
    agent = agent_with_ring(graph, folder, topics, more=f"service: {BY}, topic: {BY}")

    def heard() -> bool:
        counts, written = agent.topic("/map"), agent.status().get("recorder", {}).get("ring", {})
        # It comes as a new one again if the memory of what came was not on the disk yet.
        latched = counts.get("messages", 0) + counts.get("latched_again", 0)
        return latched > 0 and written.get("written", 0) > 200

    until(heard, within_s=WAIT_S)
    return agent


def test_a_program_keeps_by_service_and_topic_and_the_map_is_there(
    graph: AnyGraph, tmp_path: Path, published: None
) -> None:
    del published
    ring = tmp_path / "queue.ring"
    ring.mkdir()
    plan = Plan(ring)
    plan.triggers["called"] = TRIGGER
    assert plan.save()
    first = started(graph, tmp_path)
    until(lambda: [*(ring / "latched").glob("*.mcap")], within_s=WAIT_S)
    # And that it came is known to the next run.
    known = tmp_path / "queue.db.latched"
    until(lambda: known.exists() and "/map" in known.read_text(), within_s=WAIT_S)
    first.process.kill()
    agent = started(graph, tmp_path)
    caller = graph.run("caller.py", "planner", "keep", "--alone")
    caller.until(lambda: "found" in caller.lines, "service")
    caller.say("")
    caller.until(lambda: len(caller.lines) > 1, "an answer")
    assert json.loads(caller.lines[1]) == [True, "kept by called"]

    def again() -> bool:
        # The cooldown is a second at least.
        caller.say("near miss")
        return bool(agent.told()["recorder"].get("merged"))

    until(again, within_s=WAIT_S)
    (path,) = until(lambda: [*(ring / "incidents").glob("*.mcap")], within_s=WAIT_S)
    messages: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages():
            messages.setdefault(channel.topic, []).append(message)
        about = {one.name: one.metadata for one in reader.iter_metadata()}
    incident, account = about["iort.incident"], about["iort.account"]
    assert incident["why"] == "called by a program on the robot; near miss"
    assert len(messages["/wheel"]) > 50
    (latched,) = messages["/map"]
    assert latched.log_time == int(incident["ring_from_us"]) * 1000
    assert json.loads(account["/map"]) == {"stream": "map", "messages": 0, "missing": 0, "latched": 1}
    caller.kill()
