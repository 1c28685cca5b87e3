"""A connection to a rosbridge server that comes back whenever it is lost, with its subscriptions.

roslibpy is no choice: it needs Python 3.9 and twelve packages around twisted, and does not always restore its
subscriptions (its issues 108 and 114). websocket-client carries the protocol, has no dependencies, and is in
Debian.

Clients of one server (rosbridge_suite 0.11.17) share one ROS subscription a topic. The server forgets
``subscribe`` without an answer if it has no type and nobody has advertised the topic; to repeat it does no
harm in ROS 1. ``unsubscribe`` by the last client ends the ROS subscription, and the messages until the next
one are lost; so it is sent only if the server seems deaf.
"""

from __future__ import annotations

import json
import logging
import random
import threading
from typing import Any, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_contract.checks import json_text

# A message so soon after a new subscription would have come without it, if the server had not been deaf.
_AT_ONCE_S = 5.0
# A topic is silent only after this many of its own longest intervals.
_INTERVALS = 4.0


class Times(NamedTuple):
    """Timeouts and intervals in seconds.

    A ping is sent after `ping_s` without a frame; after `dead_s` the connection is dead. A topic without a
    message may not have existed at the subscription: it is subscribed to again every `ask_again_s`. After
    `patience_s` without a message, on a topic that was silent in all of this connection or on all topics, the
    server may be deaf, as after a restart of the ROS master; the time doubles up to `max_patience_s`. A robot
    has one agent, so its server may be tried often: `backoff_s` is the first and the longest backoff.
    """

    ping_s: float = 5.0
    dead_s: float = 15.0
    ask_again_s: float = 2.0
    patience_s: float = 10.0
    max_patience_s: float = 320.0
    backoff_s: tuple[float, float] = (0.25, 2.0)
    look_s: float = 1.0


TIMES = Times()


class Topic(NamedTuple):
    """A subscription: ``kind`` is the message's type; without it the topic must exist."""

    name: str
    kind: str | None = None
    throttle_ms: int = 0


class Subscription:
    """When a topic was heard, and when it is subscribed to again."""

    def __init__(self, topic: Topic, times: Times) -> None:
        self.topic = topic
        self._times = times
        self.interruptions = self.resubscribed = 0
        self.dark_s = 0.0
        self.heard = False
        self.due = self.ask_again = 0.0
        # Whether it was heard at all, and in this connection.
        self._ever = self._going = False
        self._patience = self._times.patience_s
        self._last = 0.0
        self._longest_s = 0.0
        # At the last fresh subscription: since when nothing had come, and the time of it.
        self._doubted: tuple[float, float] | None = None

    def connected(self, now: float) -> None:
        """A connection begins."""
        self.heard = self._going = False
        self._doubted = None
        self._last = now
        self._patience = self._times.patience_s
        self.due, self.ask_again = now + self._least_s(), now + self._times.ask_again_s

    def hear(self, now: float) -> None:
        """A new message has come."""
        if self._doubted is not None:
            since, at = self._doubted
            self._doubted = None
            if now - at <= _AT_ONCE_S:
                self.interruptions += 1
                self.dark_s += at - since
        elif self._going:
            self._longest_s = max(self._longest_s, now - self._last)
        self._going = self._ever = True
        self._last = now

    def silent(self, now: float) -> bool:
        """Whether the topic has been silent for longer than is normal for it."""
        return now - self._last >= self._least_s()

    def _least_s(self) -> float:
        return max(self._times.patience_s, _INTERVALS * self._longest_s)

    def resubscribing(self, now: float) -> None:
        """The topic is subscribed to afresh."""
        if self._ever:
            # The earlier messages are known, so a message that comes at once was published all the time.
            self.resubscribed += 1
            self._doubted = (self._last, now)
        self._patience = min(self._times.max_patience_s, self._patience * 2)
        self.due, self.ask_again = now + self._patience, now + self._times.ask_again_s


_log = logging.getLogger(__name__)

_CONNECT_S = 5.0
# A receive returns after this at the latest, so that a stop is noticed.
_RECEIVE_S = 0.25


class Listener(Protocol):
    """Is called in the connection's thread, and must not raise."""

    def connected(self) -> None:
        """A connection has been made; the subscriptions follow."""

    def subscribed(self, topic: str) -> None:
        """A subscription has begun or begun again: a latched message comes again."""

    def message(self, topic: str, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message of a topic, and its text ``data``; returns whether it is a new one."""

    def answer(self, said: Mapping[str, Any]) -> None:
        """Take the answer to a call."""

    def look(self) -> None:
        """Called about once a second."""


class RosbridgeConnection:
    """`run` it in a thread of its own."""

    def __init__(
        self, url: str, clock: Clock, *, topics: Sequence[Topic], listener: Listener, times: Times
    ) -> None:
        self.connects = 0
        self._url = url
        self._clock = clock
        self._times = times
        self._subscriptions = {topic.name: Subscription(topic, times) for topic in topics}
        self._listener = listener
        self._throttled = ThrottledLog(_log, clock)
        self._socket: Any = None
        self._fragments: list[str] = []
        self._patience = times.patience_s
        self._all_due = 0.0
        # The time without a connection, and since when there is none.
        self._interruptions = 0
        self._dark_s = 0.0
        self._dark_since: float | None = None

    def run(self, stop: threading.Event) -> None:
        """Be connected until ``stop`` is set. Raises `SourceError` without websocket-client."""
        library = _load_websocket()
        first_s, longest_s = self._times.backoff_s
        backoff_s = first_s
        while not stop.is_set():
            began = self._clock.monotonic()
            try:
                self._session(library, stop)
            except (OSError, library.WebSocketException) as error:
                why = _why(error, library)
                self._throttled.warn(f"connection: {why[:80]}", f"{self._url}: {why}; trying again")
            finally:
                if self._socket is not None:
                    self._socket.shutdown()
                self._socket = None
            if self._clock.monotonic() - began > longest_s:
                backoff_s = first_s
            # Full jitter, so that a fleet does not come back in step.
            self._clock.wait(stop, random.uniform(0, backoff_s))  # noqa: S311 - jitter, not secrets
            backoff_s = min(longest_s, backoff_s * 2)

    def send(self, operation: Mapping[str, Any]) -> None:
        """Send an operation; only for the listener, in the connection's thread."""
        self._socket.send(json.dumps(operation))

    def counts(self) -> dict[str, int]:
        """The problems, by reason."""
        return self._throttled.counts()

    def report(self, topic: str) -> dict[str, Any]:
        """How often a topic's messages could not come, and for how many seconds.

        ``interruptions`` and ``dark_s`` count lost connections and a deaf server; ``resubscribed`` is how
        often the topic's subscription was ended and made again.
        """
        subscription, since = self._subscriptions[topic], self._dark_since
        now_s = 0.0 if since is None else self._clock.monotonic() - since
        counts = {
            "interruptions": self._interruptions + subscription.interruptions,
            "dark_s": round(self._dark_s + now_s + subscription.dark_s, 3),
            "resubscribed": subscription.resubscribed,
        }
        return {name: count for name, count in counts.items() if count}

    def _session(self, library: Any, stop: threading.Event) -> None:
        socket = self._socket = library.create_connection(
            self._url, timeout=_CONNECT_S, skip_utf8_validation=True
        )
        socket.settimeout(_RECEIVE_S)
        self._fragments = []
        self.connects += 1
        _log.info("%s: connected", self._url)
        self._listener.connected()
        now = last_frame = last_look = self._clock.monotonic()
        self._heard(now)
        for subscription in self._subscriptions.values():
            subscription.connected(now)
            self._subscribe(subscription.topic)
        if self._dark_since is not None:
            self._dark_s += self._clock.monotonic() - self._dark_since
            self._dark_since = None
        try:
            while not stop.is_set():
                try:
                    opcode, frame = socket.recv_data_frame(control_frame=True)
                except library.WebSocketTimeoutException:
                    opcode, frame = None, None
                arrival_us, now = self._clock.now_us(), self._clock.monotonic()
                if opcode is not None:
                    last_frame = now
                if opcode in (library.ABNF.OPCODE_TEXT, library.ABNF.OPCODE_BINARY):
                    self._take(frame.data, arrival_us, now)
                elif opcode == library.ABNF.OPCODE_CLOSE:
                    raise library.WebSocketConnectionClosedException("the server closed the connection")
                if now - last_look >= self._times.look_s:
                    last_look = now
                    self._look(now, last_frame)
        finally:
            if not stop.is_set():
                self._interruptions += 1
                self._dark_since = last_frame

    def _heard(self, now: float) -> None:
        self._patience, self._all_due = self._times.patience_s, now + self._times.patience_s

    def _look(self, now: float, last_frame: float) -> None:
        """Check once a second that the server is there, and that it hears what is published."""
        if now - last_frame >= self._times.dead_s:
            raise TimeoutError(f"no answer for {self._times.dead_s:g} s")
        if now - last_frame >= self._times.ping_s:
            self._socket.ping()
        subscriptions = list(self._subscriptions.values())
        if now >= self._all_due and all(subscription.silent(now) for subscription in subscriptions):
            self._throttled.warn("silent", f"{self._url}: nothing comes on any topic: subscribing afresh")
            self._patience = min(self._times.max_patience_s, self._patience * 2)
            self._all_due = now + self._patience
            for subscription in subscriptions:
                self._resubscribe(subscription, now)
        for subscription in subscriptions:
            name = subscription.topic.name
            if not subscription.heard and now >= subscription.due:
                why = f"{self._url}: nothing comes on {name}: subscribing afresh"
                self._throttled.warn(f"silent {name}", why)
                self._resubscribe(subscription, now)
            elif not subscription.heard and now >= subscription.ask_again:
                subscription.ask_again = now + self._times.ask_again_s
                self._subscribe(subscription.topic)
        self._listener.look()

    def _resubscribe(self, subscription: Subscription, now: float) -> None:
        name = subscription.topic.name
        subscription.resubscribing(now)
        self.send({"op": "unsubscribe", "id": f"iort:{name}", "topic": name})
        self._subscribe(subscription.topic)

    def _subscribe(self, topic: Topic) -> None:
        wanted: dict[str, Any] = {"op": "subscribe", "id": f"iort:{topic.name}", "topic": topic.name}
        if topic.kind is not None:
            wanted["type"] = topic.kind
        # Without a queue, a throttled topic gives its newest message, not an old one.
        self.send({**wanted, "throttle_rate": topic.throttle_ms, "queue_length": 0})
        self._listener.subscribed(topic.name)

    def _take(self, data: bytes, arrival_us: int, now: float) -> None:
        try:
            # rosbridge's JSON has NaN.
            said = json.loads(json_text(data, "it"))
            operation = said["op"]
            if operation == "fragment":
                whole = self._whole(said)
                if whole is not None:
                    self._take(whole, arrival_us, now)
                return
            if operation == "publish":
                subscription, message = self._subscriptions.get(str(said["topic"])), said["msg"]
        except (ValueError, KeyError, TypeError) as error:
            self._throttled.warn("malformed", f"{self._url}: a message is no rosbridge message: {error!r}")
            return
        if operation == "publish":
            if subscription is not None:
                subscription.heard = True
                # A latched message comes with a subscription, and tells nothing of what is published.
                if self._listener.message(subscription.topic.name, message, data, arrival_us):
                    subscription.hear(now)
                    self._heard(now)
        elif operation == "service_response":
            self._listener.answer(said)
        elif operation == "status":
            if said.get("level") in ("error", "warning"):
                what = str(said.get("msg", ""))[:500]
                self._throttled.warn(f"server: {what[:80]}", f"{self._url}: the server says: {what}")
        else:
            what = f"{self._url}: the server sends the unknown operation {operation!r:.40}"
            self._throttled.warn("unknown", what)

    def _whole(self, said: Mapping[str, Any]) -> bytes | None:
        """The message that the server has cut because of its length, after its last part."""
        fragments, number = self._fragments, int(said["num"])
        if number == 0:
            fragments.clear()
        elif number != len(fragments):
            raise ValueError(f"part {number} of a message came after {len(fragments)} others")
        fragments.append(str(said["data"]))
        if len(fragments) < int(said["total"]):
            return None
        whole = "".join(fragments).encode()
        fragments.clear()
        return whole


def _load_websocket() -> Any:
    try:
        # Only a robot with rosbridge needs it: pip install iort-agent[rosbridge].
        import websocket  # noqa: PLC0415 - optional
    except ImportError as error:
        raise SourceError(
            "rosbridge needs the package websocket-client: pip install 'iort-agent[rosbridge]'"
        ) from error
    return websocket


def _why(error: Exception, library: Any) -> str:
    """Why there is no connection, in words that help."""
    if isinstance(error, ConnectionRefusedError):
        return "nobody listens there: is rosbridge_server running?"
    if isinstance(error, library.WebSocketBadStatusException):
        return f"what listens there is no rosbridge server: {str(error)[:100]}"
    if isinstance(error, library.WebSocketAddressException):
        return f"the host is not known: {error}"
    if isinstance(error, (library.WebSocketTimeoutException, TimeoutError)):
        return f"no answer: {error}"
    return f"connection lost: {error}"
