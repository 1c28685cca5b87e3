"""A rosbridge server of the mixed robot's graph: the stand-in, with messages from a node in the graph."""

from __future__ import annotations

import base64
import threading
from collections import defaultdict

from typing_extensions import Self

from testkit.ros1_types import as_json
from tests.ros.conftest import Graph
from tests.ros.mixed.robot import TOPICS
from tests.rosbridge_standin import RosbridgeStandin


class GraphServer(RosbridgeStandin):
    """Serves the graph's topics while it is entered. ``unheard`` has the messages by topic that arrived
    without a subscription.
    """

    def __init__(self, graph: Graph) -> None:
        super().__init__(
            advertised={name: topic.kind for name, topic in TOPICS.items()},
            definitions={topic.kind: topic.message.definition for topic in TOPICS.values()},
        )
        self.unheard: dict[str, list[bytes]] = defaultdict(list)
        self._graph = graph
        self._ended = threading.Event()
        self._pump = threading.Thread(target=self._feed, name="feed", daemon=True)

    def __enter__(self) -> Self:
        super().__enter__()
        self.feed = self._graph.run("mixed_feed.py")
        self._pump.start()
        return self

    def __exit__(self, *found: object) -> None:
        self._ended.set()
        self.feed.quit()
        self._pump.join()
        super().__exit__(*found)

    def _feed(self) -> None:
        done = 0
        while not self._ended.wait(0.01):  # the pace of a busy server
            lines = self.feed.lines[done:]
            done += len(lines)
            for line in lines:
                name, content = line.split(" ")
                topic, data = TOPICS[name], base64.b64decode(content)
                latch = "/base" if topic.latched else None
                heard = self.publish(name, as_json(topic.message, data), latch=latch)
                if not heard and not topic.latched:
                    self.unheard[name].append(data)
