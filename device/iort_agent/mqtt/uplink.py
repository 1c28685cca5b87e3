"""The connection to the broker as the other rooms use it. `iort_agent.mqtt.aws` implements it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, NamedTuple, Optional, Protocol

from iort_agent.common.state import Connection
from iort_agent.common.threads import Clock
from iort_agent.errors import UplinkError
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_contract.topics import build_topic

# Called once for a publish: with None when the broker has acknowledged it (QoS 1) or it was written (QoS 0).
# For QoS 0 it may be called within `publish`, and in any thread: it may only note the outcome.
Done = Callable[[Optional[UplinkError]], None]
# Called with True after every connect, with False after every loss.
OnConnection = Callable[[bool], None]


class MqttMessage(NamedTuple):
    """A received message; ``at`` is the monotonic time of its arrival, before any queue."""

    topic: str
    payload: bytes
    at: float


OnMessage = Callable[[MqttMessage], None]


class Uplink(Protocol):
    """A connection that reconnects by itself, and that keeps no message when it is lost.

    One thread calls all handlers, in order and never within a call of these methods; only `Done` of QoS 0
    is called elsewhere. Handlers may publish, but must not wait. They are registered before `start`.
    """

    def on_connection(self, handler: OnConnection) -> None:
        """Call the handler after every connect and every loss."""

    def subscribe(self, topic_filter: str, handler: OnMessage) -> None:
        """Receive what matches the filter: at once if connected, and after every reconnect."""

    def subscribed(self, topic_filter: str) -> bool:
        """Whether the broker has confirmed the subscription on this connection."""

    def connected(self) -> bool:
        """Whether the broker has accepted the connection and no loss is known."""

    def status(self) -> Connection:
        """The state of the connection."""

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Done) -> None:
        """Send a message. Never blocks, never raises, always calls ``done``."""

    def start(self) -> None:
        """Connect, and stay connected. Raises `UplinkError` if another try would not help."""

    def stop(self, timeout_s: float) -> None:
        """Unsubscribe, disconnect and end; unacknowledged publishes fail."""


def ignore(_: UplinkError | None) -> None:
    """Ignore the outcome of a publish."""


@dataclass(frozen=True)
class Link:
    """One robot's connection, as all its publishers share it: the uplink, the rate limiter and the topics."""

    robot: str
    namespace: str
    uplink: Uplink
    clock: Clock
    rate_limiter: RateLimiter

    def topic(self, lane: str, name: str) -> str:
        """The robot's topic of this lane and name."""
        return build_topic(lane, self.robot, name, self.namespace)

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Done = ignore) -> None:
        """Publish, and charge the rate limiter. It was asked before, or the message is rare."""
        self.rate_limiter.spend(topic, payload)
        self.uplink.publish(topic, payload, qos=qos, done=done)


def matches(topic_filter: str, topic: str) -> bool:
    """Whether a topic matches an MQTT filter (``+`` one level, ``#`` the rest)."""
    levels, wanted = topic.split("/"), topic_filter.split("/")
    for i, level in enumerate(wanted):
        if level == "#":
            return True
        if i >= len(levels) or level not in ("+", levels[i]):
            return False
    return len(levels) == len(wanted)
