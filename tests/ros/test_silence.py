"""`iort-agent status` on a silent topic: an old message never counts as new again."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from iort_agent.errors import AgentError
from iort_agent.status import SOCKET, fetch
from testkit.waiting import until
from tests.local.faults.test_uplink import self_signed
from tests.ros.conftest import Graph, Process
from tests.ros.test_source import WHEEL
from tests.unit.agent.test_agent import config_file

WAIT_S = 120


class Car:
    """The real agent in a graph, without a reachable broker, and its status."""

    def __init__(self, graph: Graph, folder: Path, plan_time: str) -> None:
        topics = {
            "/wheel": {"stream": "wheel", "time": "header"},
            "/plan": {"stream": "plan", "time": plan_time},
        }
        source = yaml.safe_dump({"type": "ros1", "topics": topics}, default_flow_style=True, width=1000)
        self._folder = folder
        config = config_file(folder, source.strip(), "queue: {path: queue.db}\nport: 1")
        self_signed(folder)
        for made, named in (("private.key", "key.pem"), ("certificate.pem", "cert.pem")):
            (folder / made).replace(folder / named)
        (folder / "ca.pem").write_bytes((folder / "cert.pem").read_bytes())
        self.process = graph.module("iort_agent.cli", "run", "--config", config, "--drain-s", 0)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = until(self._answer, within_s=WAIT_S)
        return found

    def _answer(self) -> dict[str, Any]:
        assert self.process.alive(), "\n".join(self.process.errors)
        try:
            return fetch(self._folder / SOCKET)
        except AgentError:
            return {}  # no answer yet, or a busy agent

    def samples(self) -> dict[str, int]:
        streams = self.status().get("streams", {})
        return {name: streams.get(name, {}).get("samples", 0) for name in ("wheel", "plan")}

    def topic(self, name: str) -> dict[str, Any]:
        (source,) = self.status().get("sources", [{}])
        found: dict[str, Any] = source.get(name, {})
        return found


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
    car = Car(graph, tmp_path, plan_time)
    publisher(graph, "wheel", "--count", 20)
    plan = publisher(graph, "plan", *latched)
    until(lambda: car.samples() == {"wheel": 20, "plan": 1}, within_s=WAIT_S)
    until(lambda: car.topic("/wheel")["silent"] and car.topic("/plan")["silent"], within_s=WAIT_S)
    car.process.until_said("topic /wheel has been silent")

    plan.kill()
    plan = publisher(graph, "plan", *latched)
    until(lambda: car.topic("/plan").get("latched_again") == 1, within_s=WAIT_S)
    graph.master.kill()
    car.process.until_said("does not answer")
    graph.start_master()
    car.process.until_said("registered again")
    assert car.samples() == {"wheel": 20, "plan": 1}
    stale = car.status()["streams"]
    assert all(stale[name]["silent_s"] >= 5 and stale[name]["per_s"] == 0 for name in ("wheel", "plan"))
    assert car.topic("/wheel")["silent"]
    assert car.topic("/plan")["silent"]

    plan.kill()
    publisher(graph, "plan", *latched, "--start", 7)
    until(lambda: car.samples() == {"wheel": 20, "plan": 2}, within_s=WAIT_S)
    car.process.until_said("topic /plan is heard again")
    assert car.process.terminate() == 0, "\n".join(car.process.errors)
