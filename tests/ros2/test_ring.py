"""The recorder's ring in a real graph of ROS 2: what a killed agent leaves of it."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

from tests.ros.test_ring import RATE, agent_with_ring, killed
from tests.ros2.conftest import Graph

KIND = "geometry_msgs/msg/PointStamped"


def test_a_killed_agent_leaves_every_message_but_the_last_seconds(graph: Graph, tmp_path: Path) -> None:
    agent = agent_with_ring(
        graph,
        tmp_path,
        {
            "/point": {"stream": "point", "time": "header", "fields": ["x"]},
            "/alone": {"stream": "alone", "time": "header", "only": "ring"},
        },
    )
    for topic in ("/point", "/alone"):
        graph.publisher(topic.strip("/"), topic, KIND, field="point.x", rate=RATE)
    heard = killed(agent, 2)
    for messages in heard.values():
        schemas = {(schema.name, schema.encoding) for schema, _, _, _ in messages}
        assert schemas == {(KIND, "ros2msg")}
        assert "float64 x" in messages[0][0].data.decode()
        assert {channel.message_encoding for _, channel, _, _ in messages} == {"cdr"}
        assert [number for _, _, number, _ in messages] == list(range(len(messages)))
        # Three numbers are at a message's end, and x is the first of them.
        xs = [struct.unpack_from("<d", data, len(data) - 24)[0] for _, _, _, data in messages]
        assert xs == [xs[0] + n for n in range(len(xs))]
    if graph.ros2.has("ros2bag") and graph.ros2.has("rosbag2_storage_mcap"):
        closed = min((tmp_path / "queue.ring").glob("*.mcap"))
        info = subprocess.run(
            ["ros2", "bag", "info", str(closed)],
            env=graph.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert "/alone" in info.stdout, info.stderr
