"""A ROS 2 graph without ROS: the session of a node, whose publishers are the test's."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from iort_agent.errors import SourceError
from iort_agent.ros.qos import Offer, Request
from iort_agent.ros.ros1_types import OnTrigger
from iort_agent.ros.ros2_session import INCOMPATIBLE, Endpoint, Take, Told
from iort_agent.ros.ros2_types import Installed, Types

RELIABLE = Offer(reliable=True, transient_local=False)
LATCHED = Offer(reliable=True, transient_local=True)
BEST_EFFORT = Offer(reliable=False, transient_local=False)


def fits(asked: Offer, offer: Offer) -> bool:
    """Whether the middleware connects a request and an offer."""
    return offer.reliable >= asked.reliable and offer.transient_local >= asked.transient_local


@dataclass(eq=False)
class FakePublisher:
    """A publisher of the graph; a latched one repeats its last message to each new subscription."""

    graph: FakeGraph
    topic: str
    endpoint: Endpoint
    last: tuple[bytes, int] | None = None

    def publish(self, data: bytes, source_ns: int = 0) -> None:
        self.graph.now_ns += 1
        self.last = data, source_ns or self.graph.now_ns
        for one in self.graph.subscriptions:
            if one.hears(self):
                one.queue.append(self.last)

    def end(self) -> None:
        self.graph.publishers_.remove(self)


@dataclass(eq=False)
class FakeSubscription:
    graph: FakeGraph
    topic: str
    kind: str
    request: Request
    take: Take
    told: Told
    queue: list[tuple[bytes, int]] = field(default_factory=list)

    def hears(self, publisher: FakePublisher) -> bool:
        same = (publisher.topic, publisher.endpoint.kind) == (self.topic, self.kind)
        return same and fits(self.request.offer, publisher.endpoint.offer)

    def publishers(self) -> int:
        return sum(map(self.hears, self.graph.publishers_)) if self.graph.connects else 0

    def drain(self) -> None:
        while self.queue:
            data, source_ns = self.queue.pop(0)
            self.take(data, {"source_timestamp": source_ns})

    def close(self) -> None:
        self.graph.subscriptions.remove(self)


@dataclass(eq=False)
class FakeOwn:
    """What the node publishes."""

    graph: FakeGraph
    topic: str

    def publish(self, data: bytes) -> None:
        self.graph.published.append((self.topic, data))

    def subscribers(self) -> int:
        return 3


class FakeGraph:
    """A session, and the graph that it is in."""

    def __init__(self, name: str = "iort_agent") -> None:
        self.name, self.sim_time, self.connects = f"/{name}", False, True
        self.now_ns = 1_700_000_000_000_000_000
        self.publishers_: list[FakePublisher] = []
        self.subscriptions: list[FakeSubscription] = []
        self.published: list[tuple[str, bytes]] = []
        self.services: dict[str, OnTrigger] = {}
        self.others: list[str] = []
        self.remapped: dict[str, str] = {}
        self.forbidden: set[str] = set()
        self.refused: Callable[[str], bool] = lambda _topic: False
        self.fails: BaseException | None = None
        self.closed = False
        self.questions = 0
        self._woken = threading.Event()

    def join(self, _name: str) -> FakeGraph:
        return self

    def publisher(
        self, topic: str, kind: str, offer: Offer = RELIABLE, type_hash: str = "", node: str = "/driver"
    ) -> FakePublisher:
        publisher = FakePublisher(self, topic, Endpoint(kind, offer, type_hash, node))
        self.publishers_.append(publisher)
        for one in self.subscriptions:
            if (one.topic, one.kind) == (topic, kind) and not one.hears(publisher):
                one.told(INCOMPATIBLE, 1)
        return publisher

    # The session.

    def resolve(self, topic: str) -> str:
        if topic in self.forbidden:
            raise RuntimeError("failed to resolve name")
        return self.remapped.get(topic, topic)

    def topics(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for one in self.publishers_:
            kinds = found.setdefault(one.topic, [])
            if one.endpoint.kind not in kinds:
                kinds.append(one.endpoint.kind)
        return found

    def publishers(self, topic: str) -> Sequence[Endpoint]:
        self.questions += 1
        return [one.endpoint for one in self.publishers_ if one.topic == topic]

    def count(self, topic: str) -> int:
        return sum(one.topic == topic for one in self.publishers_)

    def nodes(self, name: str) -> Sequence[str]:
        return [f"{i}" for i, one in enumerate([self.name, *self.others]) if one == name]

    def subscribe(
        self, topic: str, message_class: Any, request: Request, take: Take, told: Told
    ) -> FakeSubscription:
        if self.refused(topic):
            raise RuntimeError("no room")
        made = FakeSubscription(self, topic, message_class, request, take, told)
        self.subscriptions.append(made)
        for publisher in self.publishers_:
            if request.offer.transient_local and publisher.last and made.hears(publisher):
                made.queue.append(publisher.last)
        return made

    def advertise(self, topic: str, _message_class: Any, _depth: int) -> FakeOwn:
        return FakeOwn(self, topic)

    def offer(self, service: str, _trigger: Any, handler: OnTrigger) -> None:
        if service in self.forbidden:
            raise RuntimeError("invalid service name")
        self.services[service] = handler

    def wait(self, timeout_s: float) -> None:
        if self.fails is not None:
            raise self.fails
        self.deliver()
        self._woken.wait(min(timeout_s, 0.01))
        self._woken.clear()

    def deliver(self) -> None:
        for one in [*self.subscriptions]:
            one.drain()

    def events(self) -> None:
        """The events come at once."""

    def wake(self) -> None:
        self._woken.set()

    def close(self) -> None:
        self.closed = True


class FakeTypes(Types):
    """The types of a machine, by their definitions; the class of each is its name."""

    def __init__(self, texts: Mapping[str, str], hashes: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self.texts, self.hashes = dict(texts), hashes or {}

    def found(self, kind: str) -> Installed:
        if kind not in self.texts:
            raise SourceError(f"the ROS type {kind} is not installed")
        return Installed(kind, self.texts[kind], self.hashes.get(kind, f"sha256_{kind}"))
