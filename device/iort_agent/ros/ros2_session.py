"""A session in a ROS 2 graph, as the agent's node needs it: the seam behind which `ros2_wait` has rclpy."""

from __future__ import annotations

from typing import Any, Callable, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.ros.qos import Offer, Request
from iort_agent.ros.ros1_types import OnTrigger

LOST, INCOMPATIBLE = "lost_by_middleware", "incompatible_qos"

# Takes a message: its bytes, and what the middleware tells of it, such as source_timestamp.
Take = Callable[[bytes, Mapping[str, Any]], None]
# Takes what the middleware tells of a subscription: `LOST` or `INCOMPATIBLE`, and how many.
Told = Callable[[str, int], None]


class Endpoint(NamedTuple):
    """A publisher of a topic, as the graph tells it. ``type_hash`` is empty where the distribution or the
    publisher tells none."""

    kind: str
    offer: Offer
    type_hash: str
    node: str


class Subscription(Protocol):
    """A subscription to one type of a topic."""

    def publishers(self) -> int:
        """How many publishers it is connected to."""

    def drain(self) -> None:
        """Take what waits, however much it is."""

    def close(self) -> None:
        """End it."""


class Publisher(Protocol):
    """A publisher of a topic."""

    def publish(self, data: bytes) -> None:
        """Publish a message's bytes."""

    def subscribers(self) -> int:
        """How many subscribers it is connected to."""


class Session(Protocol):
    """A node in the graph. Only `Publisher.publish`, `wake` and the questions may be called in any thread;
    all else in the one that calls `wait`."""

    name: str
    sim_time: bool

    def resolve(self, topic: str) -> str:
        """A topic's name in the graph, as the command line may remap it."""

    def topics(self) -> Mapping[str, Sequence[str]]:
        """The topics in the graph, and the types of each."""

    def publishers(self, topic: str) -> Sequence[Endpoint]:
        """The publishers of a topic."""

    def count(self, topic: str) -> int:
        """How many publishers a topic has; cheaper than `publishers`."""

    def nodes(self, name: str) -> Sequence[str]:
        """An identifier of each node of a full name."""

    def subscribe(
        self, topic: str, message_class: Any, request: Request, take: Take, told: Told
    ) -> Subscription:
        """Subscribe to a type of a topic."""

    def advertise(self, topic: str, message_class: Any, depth: int) -> Publisher:
        """Become a publisher of a topic, reliable and volatile."""

    def offer(self, service: str, trigger: Any, handler: OnTrigger) -> None:
        """Answer a service's calls, each in a thread of its own."""

    def wait(self, timeout_s: float) -> None:
        """Deliver what comes, until something has been delivered, `wake` is called or the time is over."""

    def events(self) -> None:
        """Tell what the middleware has counted."""

    def wake(self) -> None:
        """End `wait`."""

    def close(self) -> None:
        """Leave the graph."""
