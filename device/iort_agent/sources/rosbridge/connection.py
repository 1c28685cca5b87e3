"""A connection to a rosbridge server that comes back whenever it is lost, with its subscriptions.

Why not roslibpy: it needs Python 3.9 and twelve packages around twisted, and its subscriptions are not
always restored (its issues 108 and 114). The protocol is JSON with an operation each for subscribing,
advertising, publishing and calling; websocket-client carries it, without dependencies, and Debian packages
it.

What the server does (rosbridge_suite 0.11.17): clients share one ROS subscription a topic. ``subscribe`` to
a topic without a type that nobody has advertised is forgotten without an answer; said again it does no harm
in ROS 1. ``unsubscribe`` by the last client ends the ROS subscription, and what is published until the next
has reached the publishers is lost; so it is done only where the server must be thought deaf.
"""

from __future__ import annotations

import contextlib
import json
import logging
import random
import threading
from socket import SHUT_RDWR
from typing import Any, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.clock import Clock
from iort_agent.common.throttled_log import ThrottledLog
from iort_agent.errors import SourceError

_log = logging.getLogger(__name__)

_CONNECT_S = 5.0
# A receive returns after this at the latest, so that a stop is noticed.
_RECEIVE_S = 0.25
# What comes so soon after a new subscription would have come without it, had the server not been deaf.
_AT_ONCE_S = 5.0
# A topic is silent only after so many of its own longest intervals.
_INTERVALS = 4.0


class Times(NamedTuple):
    """How long what is waited for, in seconds.

    A ping after `ping_s` without a word; without one after `dead_s`, the connection is dead. A topic that has
    not been heard may not have existed when it was subscribed to: it is asked for again every `ask_again_s`.
    After `patience_s` without a message, on a topic never heard in this connection or on all at once, the
    server may have gone deaf, as when the ROS master was started again; twice as long for each time after, up
    to `max_patience_s`. A robot has one agent, so its server may be tried often: `backoff_s`, at first and at
    most.
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
    """What is asked of the server: ``kind`` is the message's type; without it the topic must exist."""

    name: str
    kind: str | None = None
    throttle_ms: int = 0


class Listener(Protocol):
    """Is told what comes, in the connection's thread. Nothing of it may raise."""

    def connected(self) -> None:
        """A connection has been made; the subscriptions follow."""

    def subscribed(self, topic: str) -> None:
        """A topic has been subscribed to, at first or anew: what is latched comes again."""

    def message(self, topic: str, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message of a topic; ``data`` is the text that it came in. Whether it is a new one."""

    def answer(self, said: Mapping[str, Any]) -> None:
        """Take the answer to a call."""

    def look(self) -> None:
        """Called once a second or so."""


class RosbridgeConnection:
    """`run` in a thread of its own; `publish` from any thread."""

    def __init__(
        self, url: str, clock: Clock, *, topics: Sequence[Topic], listener: Listener, times: Times
    ) -> None:
        self.connects = 0
        self._url = url
        self._clock = clock
        self._times = times
        self._topics = {topic.name: _Hearing(topic, times) for topic in topics}
        self._listener = listener
        self._throttled = ThrottledLog(_log, clock)
        self._lock = threading.Lock()
        self._socket: Any = None
        self._advertised: dict[str, str] = {}
        self._patience = self._times.patience_s
        self._all_due = 0.0
        # The time in which nothing could come, and since when nothing can.
        self._interruptions = 0
        self._dark_s = 0.0
        self._dark_since: float | None = None

    def run(self, stop: threading.Event) -> None:
        """Be connected until ``stop`` is set. Raises `SourceError` without websocket-client."""
        library = _load_websocket()
        backoff = self._times.backoff_s[0]
        while not stop.is_set():
            began = self._clock.monotonic()
            try:
                self._session(library, stop)
            except (OSError, library.WebSocketException) as error:
                self._say(_why(error, library))
            finally:
                self._close()
            if self._clock.monotonic() - began > self._times.backoff_s[1]:
                backoff = self._times.backoff_s[0]
            # Full jitter: a fleet must not come back in step.
            self._clock.wait(stop, random.uniform(0, backoff))  # noqa: S311 - jitter, not secrets
            backoff = min(self._times.backoff_s[1], backoff * 2)

    def publish(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        """Publish a message. Raises `SourceError` while there is no connection; nothing is kept for later."""
        try:
            operation = json.dumps({"op": "publish", "topic": topic, "msg": message}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise SourceError(f"{self._url}: {topic} cannot be published: {error}") from error
        with self._lock:
            if self._socket is None:
                raise SourceError(f"{self._url}: not connected, so nothing can be published on {topic}")
            try:
                if self._advertised.get(topic) != kind:
                    self._socket.send(json.dumps({"op": "advertise", "topic": topic, "type": kind}))
                    self._advertised[topic] = kind
                self._socket.send(operation)
            except Exception as error:
                # Half a frame may be out; after that, nothing on this connection means anything.
                with contextlib.suppress(OSError):
                    self._socket.sock.shutdown(SHUT_RDWR)
                raise SourceError(f"{self._url}: {topic} cannot be published: {error}") from error

    def send(self, operation: Mapping[str, Any]) -> None:
        """Send an operation; only for the listener, in the connection's thread."""
        with self._lock:
            self._socket.send(json.dumps(operation))

    def counts(self) -> dict[str, int]:
        """What went wrong, by reason."""
        return self._throttled.counts()

    def report(self, topic: str) -> dict[str, Any]:
        """How often a topic's messages could not come, and for how many seconds.

        ``interruptions`` and ``dark_s`` are of the connection, and of a server that turned out to be deaf;
        ``resubscribed`` is how often the topic's subscription was ended and made again.
        """
        hearing, since = self._topics[topic], self._dark_since
        now_s = 0.0 if since is None else self._clock.monotonic() - since
        counts = {
            "interruptions": self._interruptions + hearing.interruptions,
            "dark_s": round(self._dark_s + now_s + hearing.dark_s, 3),
            "resubscribed": hearing.resubscribed,
        }
        return {name: count for name, count in counts.items() if count}

    def _session(self, library: Any, stop: threading.Event) -> None:
        socket = library.create_connection(
            self._url, timeout=_CONNECT_S, enable_multithread=True, skip_utf8_validation=True
        )
        socket.settimeout(_RECEIVE_S)
        with self._lock:
            self._socket, self._advertised = socket, {}
        self.connects += 1
        _log.info("%s: connected", self._url)
        self._listener.connected()
        now = last_word = last_look = self._clock.monotonic()
        self._patience, self._all_due = self._times.patience_s, now + self._times.patience_s
        for hearing in self._topics.values():
            hearing.connected(now)
            self._subscribe(hearing.topic)
        if self._dark_since is not None:
            self._dark_s += self._clock.monotonic() - self._dark_since
            self._dark_since = None
        fragments: list[str] = []
        try:
            while not stop.is_set():
                try:
                    opcode, frame = socket.recv_data_frame(control_frame=True)
                except library.WebSocketTimeoutException:
                    opcode, frame = None, None
                arrival_us, now = self._clock.now_us(), self._clock.monotonic()
                if opcode is not None:
                    last_word = now
                if opcode in (library.ABNF.OPCODE_TEXT, library.ABNF.OPCODE_BINARY):
                    self._take(frame.data, arrival_us, now, fragments)
                elif opcode == library.ABNF.OPCODE_CLOSE:
                    raise library.WebSocketConnectionClosedException("the server closed the connection")
                if now - last_look >= self._times.look_s:
                    last_look = now
                    self._look(socket, now, last_word)
        finally:
            if not stop.is_set():
                self._interruptions += 1
                self._dark_since = last_word

    def _look(self, socket: Any, now: float, last_word: float) -> None:
        """Once a second: is the server still there, and does it hear what is published?"""
        if now - last_word >= self._times.dead_s:
            raise TimeoutError(f"no answer for {self._times.dead_s:g} s")
        if now - last_word >= self._times.ping_s:
            with self._lock:
                socket.ping()
        hearings = list(self._topics.values())
        if now >= self._all_due and all(hearing.silent(now) for hearing in hearings):
            self._throttled.warn("silent", f"{self._url}: nothing comes on any topic: subscribing afresh")
            self._patience = min(self._times.max_patience_s, self._patience * 2)
            self._all_due = now + self._patience
            for hearing in hearings:
                self._resubscribe(hearing, now)
        for hearing in hearings:
            if hearing.heard:
                continue
            if now >= hearing.due:
                name = hearing.topic.name
                self._throttled.warn(
                    f"silent {name}", f"{self._url}: nothing comes on {name}: subscribing afresh"
                )
                self._resubscribe(hearing, now)
            elif now >= hearing.ask_again:
                hearing.ask_again = now + self._times.ask_again_s
                self._subscribe(hearing.topic)
        self._listener.look()

    def _resubscribe(self, hearing: _Hearing, now: float) -> None:
        hearing.resubscribing(now)
        self.send({"op": "unsubscribe", "id": f"iort:{hearing.topic.name}", "topic": hearing.topic.name})
        self._subscribe(hearing.topic)

    def _subscribe(self, topic: Topic) -> None:
        wanted: dict[str, Any] = {"op": "subscribe", "id": f"iort:{topic.name}", "topic": topic.name}
        if topic.kind is not None:
            wanted["type"] = topic.kind
        # Without a queue, a throttled topic gives its newest message, not one from a while ago.
        self.send({**wanted, "throttle_rate": topic.throttle_ms, "queue_length": 0})
        self._listener.subscribed(topic.name)

    def _take(self, data: bytes, arrival_us: int, now: float, fragments: list[str]) -> None:
        try:
            said = json.loads(data)
            operation = said["op"]
            if operation == "fragment":
                whole = _whole(said, fragments)
                if whole is not None:
                    self._take(whole, arrival_us, now, fragments)
                return
            if operation == "publish":
                hearing, message = self._topics.get(str(said["topic"])), said["msg"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            self._throttled.warn("malformed", f"{self._url}: a message is no rosbridge message: {error!r}")
            return
        if operation == "publish":
            if hearing is not None:
                hearing.heard = True
                # What is latched comes with a subscription, and says nothing of what is published.
                if self._listener.message(hearing.topic.name, message, data, arrival_us):
                    hearing.hear(now)
                    self._patience, self._all_due = self._times.patience_s, now + self._times.patience_s
        elif operation == "service_response":
            self._listener.answer(said)
        elif operation == "status":
            if said.get("level") in ("error", "warning"):
                what = str(said.get("msg", ""))[:500]
                self._throttled.warn(f"server: {what[:80]}", f"{self._url}: the server says: {what}")
        else:
            what = f"{self._url}: the server sends the operation {operation!r:.40}, which is not known"
            self._throttled.warn("unknown", what)

    def _close(self) -> None:
        with self._lock:
            socket, self._socket = self._socket, None
        if socket is not None:
            socket.shutdown()

    def _say(self, what: str) -> None:
        """What keeps the connection from being there, once a minute for as long as it is the same."""
        self._throttled.warn(f"connection: {what[:80]}", f"{self._url}: {what}; trying again")


class _Hearing:
    """What has been heard of one topic, and when it is subscribed to again."""

    def __init__(self, topic: Topic, times: Times) -> None:
        self.topic = topic
        self._times = times
        self.interruptions = self.resubscribed = 0
        self.dark_s = 0.0
        self.heard = False
        self.due = self.ask_again = 0.0
        # Whether it was heard before, and in this connection.
        self._ever = self._going = False
        self._patience = self._times.patience_s
        self._last = 0.0
        self._longest_s = 0.0
        # Since when nothing came, when the topic was last subscribed to afresh; and when that was.
        self._doubted: tuple[float, float] | None = None

    def connected(self, now: float) -> None:
        self.heard = self._going = False
        self._doubted = None
        self._last = now
        self._patience = self._times.patience_s
        self.due, self.ask_again = now + self._least_s(), now + self._times.ask_again_s

    def hear(self, now: float) -> None:
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
        return now - self._last >= self._least_s()

    def _least_s(self) -> float:
        return max(self._times.patience_s, _INTERVALS * self._longest_s)

    def resubscribing(self, now: float) -> None:
        if self._ever:
            # What came before is known, so what comes at once has been there all the time.
            self.resubscribed += 1
            self._doubted = (self._last, now)
        self._patience = min(self._times.max_patience_s, self._patience * 2)
        self.due, self.ask_again = now + self._patience, now + self._times.ask_again_s


def _whole(said: Mapping[str, Any], fragments: list[str]) -> bytes | None:
    """The message that a server has cut because of its length, once its last part is there."""
    number, total = int(said["num"]), int(said["total"])
    if number == 0:
        fragments.clear()
    elif number != len(fragments):
        raise ValueError(f"part {number} of a message came after {len(fragments)} others")
    fragments.append(str(said["data"]))
    if len(fragments) < total:
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
    """What keeps the connection from being there, in words that help."""
    if isinstance(error, ConnectionRefusedError):
        return "nobody listens there: is rosbridge_server running?"
    if isinstance(error, library.WebSocketBadStatusException):
        return f"what listens there is no rosbridge server: {str(error)[:100]}"
    if isinstance(error, library.WebSocketAddressException):
        return f"the host is not known: {error}"
    if isinstance(error, (library.WebSocketTimeoutException, TimeoutError)):
        return f"no answer: {error}"
    return f"connection lost: {error}"
