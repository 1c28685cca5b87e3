"""What the downlink needs of a ROS graph, and the real one: the agent's own ROS 1 node."""

from __future__ import annotations

from typing import Any, Protocol

from iort_agent.clock import Clock
from iort_agent.ros1.node import OnBytes, definition_of, shared
from iort_contract.ros1.definition import Definition


class Graph(Protocol):
    """Topics to publish on and to hear, in messages' own bytes. No call waits for anybody."""

    def definition(self, kind: str) -> Definition:
        """An installed type's definition. Raises `SourceError` where there is none."""

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of a topic; again is nothing new."""

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message on an advertised topic; whether there was a graph to publish in."""

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages, of whatever type, in another thread."""

    def waits(self) -> str | None:
        """What keeps us from joining the graph, for a person."""

    def start(self) -> None:
        """Join the graph, as soon as there is one."""

    def close(self) -> None:
        """Leave it, when what was published is on its way."""


class Ros1Graph:
    """The graph of ROS_MASTER_URI, through the node that the `ros1` source uses too.

    Raises `SourceError` without rospy.
    """

    def __init__(self, node: str, clock: Clock) -> None:
        self._node = shared(node, clock)
        self._types: dict[str, tuple[Definition, Any]] = {}

    def definition(self, kind: str) -> Definition:
        """An installed type's definition. Raises `SourceError` where there is none."""
        if kind not in self._types:
            self._types[kind] = definition_of(kind)
        return self._types[kind][0]

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of a topic, not latched: an old command is no command."""
        self.definition(kind)
        self._node.advertise(self._node.resolve(topic), self._types[kind][1])

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message on an advertised topic."""
        return self._node.publish(self._node.resolve(topic), data)

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages."""
        self._node.subscribe(self._node.resolve(topic), handler)

    def waits(self) -> str | None:
        """What keeps us from joining the graph: another node of our name."""
        return self._node.waits

    def start(self) -> None:
        """Join the graph."""
        self._node.start()

    def close(self) -> None:
        """Leave the graph, unless a source still needs the node."""
        self._node.release()
