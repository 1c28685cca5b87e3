"""`iort-agent status` on a silent topic: an old message never counts as new again."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from testkit.waiting import until
from tests.ros.agents import agent_of
from tests.ros.conftest import Graph
from tests.ros.process import WAIT_S, Process
from tests.ros.test_source import WHEEL


def publisher(graph: Graph, name: str, *options: object) -> Process:
    definition = graph.folder / f"{name}.msg"
    definition.write_text(WHEEL)
    arguments = ["strange_msgs/Wheel", definition, "--field", "state.turns", *options]
    return graph.run("publisher.py", name, f"/{name}", *arguments)


@pytest.mark.parametrize("plan_time", ["header", "arrival"])
def test_a_silent_topic_is_stale_and_its_latched_message_stays_old(
    graph: Graph, tmp_path: Path, plan_time: str
) -> None:
    latched = ["--latch", "--count", 1, "--stamp", int(time.time()) - 10]
    topics = {
        "/wheel": {"stream": "wheel", "time": "header"},
        "/plan": {"stream": "plan", "time": plan_time},
    }
    car = agent_of(graph, tmp_path, {"type": "ros1", "topics": topics})

    def samples() -> tuple[int, int]:
        return car.samples("wheel"), car.samples("plan")

    publisher(graph, "wheel", "--count", 20)
    plan = publisher(graph, "plan", *latched)
    until(lambda: samples() == (20, 1), within_s=WAIT_S)
    until(lambda: all(car.topic(name).get("silent") for name in ("/wheel", "/plan")), within_s=WAIT_S)
    car.process.until_said("topic /wheel has been silent")

    plan.kill()
    plan = publisher(graph, "plan", *latched)
    until(lambda: car.topic("/plan").get("latched_again") == 1, within_s=WAIT_S)
    graph.master.kill()
    car.process.until_said("does not answer")
    graph.start_master()
    car.process.until_said("registered again")
    until(lambda: samples() == (20, 1), within_s=WAIT_S)
    stale = car.told()["streams"]
    assert all(stale[name]["silent_s"] >= 5 and stale[name]["per_s"] == 0 for name in ("wheel", "plan"))
    assert all(car.told()["sources"][0][name]["silent"] for name in ("/wheel", "/plan"))

    plan.kill()
    publisher(graph, "plan", *latched, "--start", 7)
    until(lambda: samples() == (20, 2), within_s=WAIT_S)
    car.process.until_said("topic /plan is heard again")
    assert car.process.terminate() == 0, "\n".join(car.process.errors)
