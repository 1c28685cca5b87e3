"""Fakes of the agent's seams: a clock that stands still, a broker and a spool in memory."""

from __future__ import annotations

import threading
from functools import partial
from typing import Callable, NamedTuple, Optional

from iort_agent.common.state import Connection
from iort_agent.common.threads import Clock
from iort_agent.errors import UplinkError
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Done, Link, MqttMessage, OnConnection, OnMessage, Uplink, matches
from iort_agent.spool import OVERWRITE_OLDEST, OnStored
from iort_agent.spool.memory import Memory
from iort_contract.messages.batch import RunEnd


class ManualClock:
    """A clock that stands still until told; waiting moves it, so a day passes in no time."""

    def __init__(self, *, now_us: int = 1_700_000_000_000_000, monotonic: float = 1000.0) -> None:
        self._now_us = now_us
        self._monotonic = monotonic
        self._lock = threading.Lock()

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch."""
        return self._now_us

    def monotonic(self) -> float:
        """Seconds that only `advance` and `wait` move."""
        return self._monotonic

    def advance(self, seconds: float) -> None:
        """Advance both clocks."""
        with self._lock:
            self._now_us += round(seconds * 1_000_000)
            self._monotonic += seconds

    def set_wall(self, now_us: int) -> None:
        """Let the wall clock jump, as NTP does; the monotonic clock stays."""
        self._now_us = now_us

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Pass the time at once, unless the event is set. Without a limit, really wait."""
        if seconds is None:
            return event.wait()
        if event.is_set():
            return True
        self.advance(max(0.0, seconds))
        return event.is_set()


class Published(NamedTuple):
    """A message that the broker has received."""

    topic: str
    payload: bytes
    qos: int


# The broker's reason to reject a publish; None to accept it.
Verdict = Callable[[Published], Optional[str]]


class Loopback:
    """A broker in memory that can disconnect, delay and reject.

    Publishes come back to matching subscriptions. ``hold`` delays acknowledgements, ``stalled`` also the
    notice that a message was written.
    """

    def __init__(self, clock: Clock, dispatcher: Dispatcher, *, connected: bool = True) -> None:
        self._clock = clock
        self._dispatcher = dispatcher
        self._connect_on_start = connected
        self._connected = False
        self._connects, self._switched = 0, clock.monotonic()
        self._handlers: list[OnConnection] = []
        self._subscriptions: dict[str, OnMessage] = {}
        self._waiting: list[Done] = []
        self.published: list[Published] = []
        self.hold = self.stalled = False
        self.verdict: Verdict = lambda _: None
        self.stopped = False
        self.endpoint = "localhost:8883"

    def on_connection(self, handler: OnConnection) -> None:
        """Tell the handler of every `connect` and `cut`."""
        self._handlers.append(handler)

    def subscribe(self, topic_filter: str, handler: OnMessage) -> None:
        """Receive messages that match the filter."""
        self._subscriptions[topic_filter] = handler

    def subscribed(self, topic_filter: str) -> bool:
        """Return whether the filter is subscribed and the broker connected."""
        return self._connected and topic_filter in self._subscriptions

    def connected(self) -> bool:
        """Return whether it is connected."""
        return self._connected

    def status(self) -> Connection:
        """Return the state of the connection."""
        since_s = self._clock.monotonic() - self._switched
        return Connection(self._connected, since_s, self._connects, endpoint=self.endpoint)

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Done) -> None:
        """Accept, reject or hold the message, and deliver it to the subscriptions."""
        if not self._connected:
            self._finish(done, UplinkError("not connected"))
            return
        message = Published(topic, payload, qos)
        refusal = self.verdict(message)
        if refusal is not None:
            self._finish(done, UplinkError(refusal))
            return
        self.published.append(message)
        if self.stalled or (self.hold and qos):
            self._waiting.append(done)
        elif qos:
            self._finish(done, None)
        else:
            # `Done` allows a call within `publish`.
            done(None)
        self.deliver(topic, payload)

    def deliver(self, topic: str, payload: bytes) -> None:
        """Let a message arrive, as if another client had published it."""
        message = MqttMessage(topic, payload, self._clock.monotonic())
        for topic_filter, handler in self._subscriptions.items():
            if matches(topic_filter, topic):
                self._dispatcher.post(partial(handler, message))

    def release(self, *, error: str | None = None, count: int | None = None) -> None:
        """Acknowledge the delayed publishes, or fail them: the first ``count`` or all."""
        ready = self._waiting[:count]
        del self._waiting[:count]
        for done in ready:
            self._finish(done, UplinkError(error) if error else None)

    def connect(self) -> None:
        """Let the connection come up."""
        self._switch(connected=True)

    def cut(self) -> None:
        """Lose the connection; delayed publishes fail, as with the real client."""
        self._switch(connected=False)
        self.release(error="the connection was lost")

    def start(self) -> None:
        """Connect, unless told not to."""
        self._dispatcher.start()
        if self._connect_on_start:
            self.connect()

    def stop(self, timeout_s: float) -> None:
        """Disconnect."""
        self.cut()
        self._dispatcher.stop(timeout_s)
        self.stopped = True

    def _switch(self, *, connected: bool) -> None:
        self._connected = connected
        self._connects += connected
        self._switched = self._clock.monotonic()
        for handler in self._handlers:
            self._dispatcher.post(partial(handler, connected))

    def _finish(self, done: Done, error: UplinkError | None) -> None:
        self._dispatcher.post(lambda: done(error))


def link_of(uplink: Uplink, clock: Clock, *, robot: str = "car1") -> Link:
    """Return the link of a robot in the default namespace, with the limits of AWS."""
    return Link(robot, "iort", uplink, clock, RateLimiter(clock))


class MemorySpool:
    """A spool that ends with its test."""

    alarm: str | None = None
    damaged = 0
    durable = False

    def __init__(self, *, max_bytes: int, policy: str = OVERWRITE_OLDEST) -> None:
        self._memory = Memory(max_bytes=max_bytes, policy=policy)
        self._handlers: list[OnStored] = []
        self._arrived: set[str] = set()
        self.next, self.backlog, self.dropped = self._memory.next, self._memory.backlog, self._memory.dropped

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler after every put."""
        self._handlers.append(handler)

    def previous(self, stream: str) -> tuple[RunEnd, ...] | None:
        """No runs: they are not known."""
        return None if stream in self._arrived else ()

    def put(self, stream: str, boot: str, seq: int, payload: bytes, *, samples: int) -> None:  # noqa: ARG002 - it knows no runs
        """Keep a batch."""
        self._memory.put(stream, seq, payload, samples=samples)
        for handler in self._handlers:
            handler()

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        entry = self._memory.take(entry_id)
        if entry is not None:
            self._arrived.add(entry.stream)

    def close(self) -> None:
        """Nothing to do."""
