"""What the other tests stand on: foreign nodes of one graph hear each other."""

from __future__ import annotations

import json

from tests.ros2.conftest import Graph


def test_a_listener_hears_a_publisher(graph: Graph) -> None:
    listener = graph.listener("ears", "/count", "std_msgs/msg/Float64")
    publisher = graph.publisher("mouth", "/count", "std_msgs/msg/Float64", field="data", count=10)
    publisher.until(lambda: "ready" in publisher.lines, "a subscriber")
    heard = listener.until(
        lambda: [json.loads(line)[1]["data"] for line in listener.lines if line[0] == "["][9:], "ten messages"
    )
    assert heard == [9]
    assert publisher.quit()[-1] == "sent 10"
