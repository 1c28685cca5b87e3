"""The ROS master restarts while a car drives: every sample is in the table once."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable

import pytest

from iort_agent.errors import AgentError
from iort_agent.status import SOCKET, fetch
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from testkit.waiting import until
from tests.ros.conftest import Graph, graph, ros_python  # noqa: F401 - fixtures
from tests.ros.test_source import WHEEL

pytestmark = pytest.mark.heavy

LATER, COUNT = 1000, 100


def test_a_restart_of_the_ros_master_loses_no_sample(
    embedded: EmbeddedCloud,
    bundle: Callable[..., robots.Bundle],
    graph: Graph,  # noqa: F811 - the fixture
) -> None:
    topics = {
        f"/{name}": {"stream": name, "time": "header", "fields": ["turns"]} for name in ("wheel", "other")
    }
    car = bundle(queue={"path": "spool.db"}, sources=[{"type": "ros1", "topics": topics}])
    definition, written = graph.folder / "wheel.msg", car.folder / "report.json"
    definition.write_text(WHEEL)
    agent = graph.module(
        "iort_agent.cli", "run", "--config", car.config, "--report", written, "--drain-s", 60
    )
    publisher = functools.partial(graph.run, "publisher.py")
    of_type = ["strange_msgs/Wheel", definition, "--field", "state.turns"]
    publisher("first", "/wheel", *of_type)
    agent.until_said("connected to 127.0.0.1")

    def samples_taken(stream: str) -> int:
        try:
            streams = fetch(car.folder / SOCKET)["streams"]
        except AgentError:
            return 0  # The agent is too busy to answer.
        return int(streams.get(stream, {}).get("samples", 0))

    before = until(lambda: samples_taken("wheel"))
    graph.master.kill()
    agent.until_said("does not answer")
    graph.start_master()
    agent.until_said("had forgotten /wheel, /other: registered again")
    # Existing connections need no master.
    again = until(lambda: (now := samples_taken("wheel")) > before and now)
    # The agent finds publishers that start after the restart, and receives their first sample.
    publisher("second", "/other", *of_type, "--start", LATER, "--count", COUNT)
    until(lambda: samples_taken("other") >= COUNT)
    assert agent.terminate() == 0, "\n".join(agent.errors)

    streams = json.loads(written.read_text())["streams"]
    for stream, start in (("wheel", 0), ("other", LATER)):
        batches = list(audit.batches(embedded.cloud, car.robot, stream))
        assert [batch.seq for batch in batches] == list(range(len(batches)))
        found = [value for batch in batches for value in batch.columns["turns"]]
        assert found == list(range(start, start + streams[stream]["samples"]))
    assert streams["wheel"]["samples"] > again
    assert streams["other"]["samples"] == COUNT
