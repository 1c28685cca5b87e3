"""Two publishers of one topic, each with its own clock and message shape: every message is stored, in as
few batches as possible for these clocks and seconds.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from iort_agent.errors import AgentError
from iort_agent.status import SOCKET, fetch
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from testkit.waiting import until
from tests.local.conftest import embedded  # noqa: F401 - a fixture
from tests.ros.conftest import Graph, ros_python  # noqa: F401 - a fixture
from tests.ros.mixed.robot import TOPICS

SECONDS = 10
NAMES = ("/beacons", "/joint_states")
SENT = {"beacons": 2 * 50 * SECONDS, "joint_states": (50 + 20) * SECONDS}
# A batch covers one second of a clock, and there are two; a machine that stalls divides some. A batch for
# each change from one publisher to the other would be at least 20 a second.
MOST_PER_S = 4


@pytest.fixture(scope="module")
def stored(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    ros_python: str,  # noqa: F811 - the fixture
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[dict[str, audit.Delivery], float]:
    """Return the stored batches of either stream, and the seconds that the publishers took."""
    folder = tmp_path_factory.mktemp("two")
    topics = {name: {"stream": TOPICS[name].stream, "time": "header"} for name in NAMES}
    settings = {"sources": [{"type": "ros1", "topics": topics}], "queue": {"path": "spool.db"}}
    car = robots.add(embedded.cloud, "two-publishers", out=folder, settings=settings)
    graph = Graph(ros_python, folder)
    try:
        graph.start_master()
        agent = graph.module("iort_agent.cli", "run", "--config", car.config, "--drain-s", 60)
        publishers = [_publisher(graph, node, folder) for node in ("base", "rear")]
        for publisher in publishers:
            publisher.until(lambda publisher=publisher: "ready" in publisher.lines, "connections")
        began = time.monotonic()
        for publisher in publishers:
            publisher.say("begin")
        for publisher in publishers:
            publisher.until(lambda publisher=publisher: publisher.lines[-1].startswith("sent "), "end")
        # On a busy machine the publishers are late.
        took_s = time.monotonic() - began

        def samples_by_stream() -> dict[str, int]:
            try:
                streams = fetch(car.folder / SOCKET)["streams"]
            except AgentError:
                return {}  # the agent is too busy to answer
            return {name: streams.get(name, {}).get("samples", 0) for name in SENT}

        until(lambda: samples_by_stream() == SENT, within_s=300)
        assert agent.terminate() == 0, "\n".join(agent.errors)
    finally:
        graph.stop()
    return {name: audit.delivery(embedded.cloud, car.robot, name) for name in SENT}, took_s


def _publisher(graph: Graph, node: str, folder: Path):
    return graph.run(
        "mixed_publisher.py", node, "--seconds", SECONDS, "--subscribers", 1,
        "--sent-log", folder / f"{node}.sent", "--topics", *NAMES,
    )  # fmt: skip


@pytest.mark.parametrize("stream", SENT)
def test_every_message_is_stored(stored: tuple[dict[str, audit.Delivery], float], stream: str) -> None:
    assert stored[0][stream].samples_stored == SENT[stream]


@pytest.mark.parametrize("stream", SENT)
def test_batches_per_second_stay_within_the_number_of_clocks(
    stored: tuple[dict[str, audit.Delivery], float], stream: str
) -> None:
    found, took_s = stored
    assert found[stream].batches_stored <= MOST_PER_S * (took_s + 2)
