"""What the lanes need of a connection to the broker. `iort_agent.mqtt.aws` is the real one."""

from __future__ import annotations

from typing import Callable, NamedTuple, Optional, Protocol

from iort_agent.errors import UplinkError

# Called once for a publish: None when the broker has it (QoS 1) or it was written (QoS 0). Of QoS 0 it
# hears at once, in whatever thread, even within the call: it may note that, and nothing else.
Done = Callable[[Optional[UplinkError]], None]
# Called with True after every connect, with False after every loss.
OnConnection = Callable[[bool], None]


class Message(NamedTuple):
    """A message received; ``at`` is the monotonic time of its arrival, before any queue."""

    topic: str
    payload: bytes
    at: float


OnMessage = Callable[[Message], None]


class UplinkStatus(NamedTuple):
    """How the connection stands: for how long it is (or is not) there, how often it came, and what
    last went wrong. ``certificate_id`` is what AWS calls the certificate in use."""

    connected: bool
    since_s: float
    connects: int
    last_error: str | None = None
    certificate_id: str | None = None


class Uplink(Protocol):
    """A connection that comes back by itself and keeps no message of its own over a loss.

    Callbacks run in one thread of the uplink's, in order, never within a call of these methods; they
    may publish, but not wait. What hears of QoS 0 is the exception: see `Done`. Handlers are given
    before `start`.
    """

    def on_connection(self, handler: OnConnection) -> None:
        """Tell the handler of every connect and loss."""

    def subscribe(self, topic_filter: str, handler: OnMessage) -> None:
        """Receive what matches the filter, at once where there is a connection, after every reconnect."""

    def subscribed(self, topic_filter: str) -> bool:
        """Whether the broker has confirmed the subscription on this connection."""

    def connected(self) -> bool:
        """Whether there is a connection, as far as known."""

    def status(self) -> UplinkStatus:
        """How the connection stands."""

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Done) -> None:
        """Send a message; never blocks, never raises, always calls ``done`` later."""

    def start(self) -> None:
        """Connect, and keep connected. Raises `UplinkError` where trying again would not help."""

    def stop(self, timeout_s: float) -> None:
        """Unsubscribe, disconnect and end; publishes not acknowledged by then fail."""


def matches(topic_filter: str, topic: str) -> bool:
    """Whether a topic is one that an MQTT filter (``+`` a level, ``#`` the rest) asks for."""
    levels: list[str] = topic.split("/")
    wanted = topic_filter.split("/")
    for i, level in enumerate(wanted):
        if level == "#":
            return True
        if i >= len(levels) or level not in ("+", levels[i]):
            return False
    return len(levels) == len(wanted)
