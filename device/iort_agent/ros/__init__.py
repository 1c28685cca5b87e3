"""The agent's own ROS node, installed message types, and ROS 1 messages from and to JSON. This room uses
the tools of all rooms, and knows neither sources nor lanes."""

from __future__ import annotations

from typing import Callable, Mapping, Protocol

from iort_agent.ros.ros1_types import OnTrigger
from iort_contract.ros.definition import Definition

# Takes a message: the publisher's connection header, and the message's bytes.
OnBytes = Callable[[Mapping[str, str], bytes], None]


class Graph(Protocol):
    """A ROS graph as its users see it: topics to publish and to hear, in the messages' own bytes. No call
    blocks. `iort_agent.ros.ros1_node.Node` and `iort_agent.ros.ros2_node.Node` are the real ones.

    ``ros`` is 1 or 2: the form of its types' names, and of its messages' bytes.
    """

    ros: int

    def definition(self, kind: str) -> Definition:
        """The definition of an installed type. Raises `SourceError` if it is not installed."""

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of the topic; again has no effect. Raises as `definition`."""

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message on an advertised topic; False if there is no graph to publish in."""

    def release(self, topic: str) -> None:
        """Nobody commands the topic any more, and its last stop is published."""

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages, of any type, in another thread."""

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        """Stop receiving what `subscribe` began."""

    def offer(self, service: str, handler: OnTrigger) -> None:
        """Answer calls of a service of the ROS' type Trigger, of std_srvs, each in a thread of its own."""

    def waits(self) -> str | None:
        """Why the graph cannot be joined, for a person."""

    def start(self) -> None:
        """Join the graph as soon as it is there."""

    def close(self) -> None:
        """Leave the graph once the published messages are written."""
