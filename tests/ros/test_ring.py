"""The recorder's ring in a real graph: what a killed agent leaves of topics that it records, and of one that
it keeps in the ring alone. tests/ros2 does the same."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader

from testkit.waiting import until
from tests.ros.agents import Agent, agent_of
from tests.ros.conftest import Graph
from tests.ros.process import WAIT_S
from tests.ros.test_source import WHEEL, Cars

RATE, LEAST = 200, 600


def agent_with_ring(graph: Any, folder: Path, topics: dict[str, Any], more: str = "") -> Agent:
    source = {"type": f"ros{graph.ros}", "topics": topics}
    return agent_of(graph, folder, source, more=f"recorder: {{keep_free_mb: 0, {more}}}")


def killed(agent: Agent, topics: int) -> dict[str, list[tuple[Any, Any, int, bytes]]]:
    """Kill the agent once it has written enough, and read its ring as a foreign program does: each topic's
    schemas, channels, numbers and messages."""
    ring = agent.folder / "queue.ring"

    def written() -> int:
        return int(((agent.status().get("recorder") or {}).get("ring") or {}).get("written", 0))

    until(lambda: written() >= topics * LEAST, within_s=WAIT_S)
    status = agent.told()
    assert "alone" not in status["streams"], "it is neither recorded nor live"
    agent.process.kill()
    heard: dict[str, list[tuple[Any, Any, int, bytes]]] = {}
    for path in sorted(ring.glob("*.mcap")):
        with path.open("rb") as file:
            try:
                for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                    one = (schema, channel, message.sequence, message.data)
                    heard.setdefault(channel.topic, []).append(one)
            except EndOfFile:
                pass  # the segment that was open
    assert len(heard) == topics
    assert sum(map(len, heard.values())) >= status["recorder"]["ring"]["written"], "what was on disk stays"
    return heard


def test_a_killed_agent_leaves_every_message_but_the_last_seconds(graph: Graph, tmp_path: Path) -> None:
    cars = Cars(graph)
    agent = agent_with_ring(
        graph,
        tmp_path,
        {
            "/wheel": {"stream": "wheel", "time": "header", "fields": ["state.turns"]},
            "/alone": {"stream": "alone", "time": "header", "only": "ring"},
        },
    )
    for topic in ("/wheel", "/alone"):
        cars.publisher(topic.strip("/"), topic=topic, rate=RATE)
    heard = killed(agent, 2)
    for messages in heard.values():
        schemas = {(schema.name, schema.encoding, schema.data.decode()) for schema, _, _, _ in messages}
        assert schemas == {("strange_msgs/Wheel", "ros1msg", WHEEL)}
        assert {channel.message_encoding for _, channel, _, _ in messages} == {"ros1"}
        assert [number for _, _, number, _ in messages] == list(range(len(messages)))
        turns = [turns_of(data) for _, _, _, data in messages]
        assert turns == list(range(turns[0], turns[0] + len(turns)))


def turns_of(data: bytes) -> int:
    """The counter of a message as published: behind the header."""
    (length,) = struct.unpack_from("<I", data, 12)
    (turns,) = struct.unpack_from("<i", data, 16 + length)
    return int(turns)
