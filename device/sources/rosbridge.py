"""ROS topics over the rosbridge WebSocket protocol, which serves ROS 1 and ROS 2 robots alike.

Why not roslibpy: it needs Python 3.9 and twelve packages around twisted, and its subscriptions are not
always restored (its issues 108 and 114). The protocol is JSON with an operation each for subscribing,
advertising and publishing; websocket-client carries it, without dependencies, and Debian packages it.

Samples are those of `device.sources.flatten`, and a ROS 1 time is named as in ROS 2, so a topic gives
the same fields live, from a bag and from here. JSON has no types: a ``uint8[]`` is a text here, not an
array. As in the ROS 1 source, arrays of more than `MAX_ELEMENTS` and texts that the contract would
refuse are left out, unless they are what `fields` selects.
"""

from __future__ import annotations

import contextlib
import json
import logging
import random
import threading
from dataclasses import dataclass
from socket import SHUT_RDWR
from types import SimpleNamespace
from typing import Any, Callable, Mapping, NamedTuple, Sequence
from urllib.parse import urlsplit

import contract
from contract import Value
from device.clock import Clock
from device.errors import SourceError
from device.schema import Where, choice, items, number, pairs, section, setting, text
from device.seldom import Seldom
from device.sources import Emit
from device.sources.flatten import HEADER as HEADER_FIELD
from device.sources.flatten import flatten

_log = logging.getLogger(__name__)

HEADER, ARRIVAL = "header", "arrival"
MAX_ELEMENTS = 64
_MAX_TEXT = 4096
# A stamp this far from the clock is a clock not yet set, or a simulation's.
_BELIEVABLE_US = 3600 * 1_000_000

_CONNECT_S = 5.0
# A receive returns after this at the latest, so that a stop is noticed.
_RECEIVE_S = 0.25
# A ping after so long without a word; without one after that, the connection is dead.
_PING_S = 5.0
_DEAD_S = 15.0
# A topic that has not been heard for so long is subscribed to afresh: it may not have existed, or its
# server may have gone deaf when the ROS master was started again. Twice as long for each time after.
_PATIENCE_S, _MAX_PATIENCE_S = 10.0, 320.0
_BACKOFF_S = (0.25, 10.0)


class Topic(NamedTuple):
    """What is asked of the server: ``kind`` is the message's type; without it the topic must exist."""

    name: str
    kind: str | None = None
    throttle_ms: int = 0


# Takes a message: topic, the message with objects as `SimpleNamespace`, microseconds of its arrival.
OnMessage = Callable[[str, Any, int], None]


class RosbridgeConnection:
    """A connection to a rosbridge server that comes back whenever it is lost, with its subscriptions.

    `run` in a thread of its own; `publish` from any thread.
    """

    def __init__(self, url: str, clock: Clock, *, topics: Sequence[Topic], on_message: OnMessage) -> None:
        self.connects = 0
        self._url = url
        self._clock = clock
        self._topics = {topic.name: topic for topic in topics}
        self._on_message = on_message
        self._seldom = Seldom(_log, clock)
        self._lock = threading.Lock()
        self._socket: Any = None
        self._advertised: dict[str, str] = {}
        # How long each topic may be silent, and until when.
        self._patience: dict[str, float] = {}
        self._silent_until: dict[str, float] = {}

    def run(self, stop: threading.Event) -> None:
        """Be connected until ``stop`` is set. Raises `SourceError` without websocket-client."""
        library = _load_websocket()
        backoff = _BACKOFF_S[0]
        while not stop.is_set():
            began = self._clock.monotonic()
            try:
                self._session(library, stop)
            except (OSError, library.WebSocketException) as error:
                self._say(_why(error, library))
            finally:
                self._close()
            if self._clock.monotonic() - began > _BACKOFF_S[1]:
                backoff = _BACKOFF_S[0]
            # Full jitter: a fleet must not come back in step.
            self._clock.wait(stop, random.uniform(0, backoff))  # noqa: S311 - jitter, not secrets
            backoff = min(_BACKOFF_S[1], backoff * 2)

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

    def counts(self) -> dict[str, int]:
        """What went wrong, by reason."""
        return self._seldom.counts()

    def _session(self, library: Any, stop: threading.Event) -> None:
        socket = library.create_connection(
            self._url, timeout=_CONNECT_S, enable_multithread=True, skip_utf8_validation=True
        )
        socket.settimeout(_RECEIVE_S)
        with self._lock:
            self._socket, self._advertised = socket, {}
        self.connects += 1
        _log.info("%s: connected", self._url)
        now = self._clock.monotonic()
        self._patience = dict.fromkeys(self._topics, _PATIENCE_S)
        self._silent_until = dict.fromkeys(self._topics, now + _PATIENCE_S)
        for topic in self._topics.values():
            self._subscribe(topic)
        last_word = last_look = now
        while not stop.is_set():
            try:
                opcode, frame = socket.recv_data_frame(control_frame=True)
            except library.WebSocketTimeoutException:
                opcode, frame = None, None
            arrival_us, now = self._clock.now_us(), self._clock.monotonic()
            if opcode is not None:
                last_word = now
            if opcode in (library.ABNF.OPCODE_TEXT, library.ABNF.OPCODE_BINARY):
                self._take(frame.data, arrival_us, now)
            elif opcode == library.ABNF.OPCODE_CLOSE:
                raise library.WebSocketConnectionClosedException("the server closed the connection")
            if now - last_look >= 1.0:
                last_look = now
                self._look(socket, now, last_word)

    def _look(self, socket: Any, now: float, last_word: float) -> None:
        """Once a second: is the server still there, and does every topic speak?"""
        if now - last_word >= _DEAD_S:
            raise TimeoutError(f"no answer for {_DEAD_S:g} s")
        if now - last_word >= _PING_S:
            with self._lock:
                socket.ping()
        for name, due in self._silent_until.items():
            if now >= due:
                told = f"{self._url}: nothing comes on {name}: subscribing afresh"
                self._seldom.warn(f"silent {name}", told)
                self._patience[name] = min(_MAX_PATIENCE_S, self._patience[name] * 2)
                self._silent_until[name] = now + self._patience[name]
                self._send({"op": "unsubscribe", "id": f"iort:{name}", "topic": name})
                self._subscribe(self._topics[name])

    def _subscribe(self, topic: Topic) -> None:
        wanted: dict[str, Any] = {"op": "subscribe", "id": f"iort:{topic.name}", "topic": topic.name}
        if topic.kind is not None:
            wanted["type"] = topic.kind
        # Without a queue, a throttled topic gives its newest message, not one from a while ago.
        self._send({**wanted, "throttle_rate": topic.throttle_ms, "queue_length": 0})

    def _take(self, data: bytes, arrival_us: int, now: float) -> None:
        try:
            said = json.loads(data, object_hook=_namespace)
            operation = said.op
            if operation == "publish":
                name, message = str(said.topic), said.msg
        except (ValueError, AttributeError, RecursionError) as error:
            self._seldom.warn("malformed", f"{self._url}: a message is no rosbridge message: {error!r}")
            return
        if operation == "publish":
            if name in self._topics:
                self._patience[name] = _PATIENCE_S
                self._silent_until[name] = now + _PATIENCE_S
                self._on_message(name, message, arrival_us)
        elif operation == "status" and getattr(said, "level", "") in ("error", "warning"):
            what = str(getattr(said, "msg", ""))[:500]
            self._seldom.warn(f"server: {what[:80]}", f"{self._url}: the server says: {what}")

    def _send(self, operation: Mapping[str, Any]) -> None:
        with self._lock:
            self._socket.send(json.dumps(operation))

    def _close(self) -> None:
        with self._lock:
            socket, self._socket = self._socket, None
        if socket is not None:
            socket.shutdown()

    def _say(self, what: str) -> None:
        """What keeps the connection from being there, once a minute for as long as it is the same."""
        self._seldom.warn(f"connection: {what[:80]}", f"{self._url}: {what}; trying again")


# --- the source ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TopicConfig:
    """What becomes of a topic.

    ``type`` lets the server subscribe before anybody publishes. ``time`` must be said: ``header`` is when
    it was measured, by the clock of the computer that did; ``arrival`` is when the agent received it, by
    its own clock. ``fields`` are the paths wanted, or what they begin with (``pose.position``); without
    it, all. ``throttle_ms`` is the least time between messages, kept by the server.
    """

    stream: str = setting(text(contract.check_stream))
    time: str = setting(choice(HEADER, ARRIVAL))
    type: str | None = setting(text(), default=None)
    fields: tuple[str, ...] | None = setting(
        items(text(), at_least=1, what="a list of at least one field"), default=None
    )
    throttle_ms: int = setting(number(0, 3_600_000, whole=True, unit="ms"), 0)


def _websocket_url(value: Any, where: Where) -> str:
    allowed = "the address of a rosbridge server, such as ws://localhost:9090"
    if not isinstance(value, str):
        raise where.error(value, allowed)
    try:
        parts = urlsplit(value)
        fits = parts.scheme in ("ws", "wss") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        fits = False
    if not fits:
        raise where.error(value, allowed)
    return value


@dataclass(frozen=True)
class RosbridgeConfig:
    """Topics of a rosbridge server."""

    url: str = setting(_websocket_url)
    topics: tuple[tuple[str, TopicConfig], ...] = setting(
        pairs(section(TopicConfig), what="a mapping of ROS topic to its stream and time")
    )

    def streams(self) -> Sequence[str]:
        """The streams named; several topics may share one."""
        return sorted({topic.stream for _, topic in self.topics})

    def describe(self) -> str:
        """The source in a few words."""
        return f"rosbridge {self.url}, topics {', '.join(topic for topic, _ in self.topics)}"

    def build(self, clock: Clock) -> RosbridgeSource:
        """Make the source; the connection is made when it runs."""
        return RosbridgeSource(self, clock)


class RosbridgeSource:
    """Emits each message of the topics."""

    def __init__(self, config: RosbridgeConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._intakes: dict[str, Intake] = {}
        topics = [Topic(name, topic.type, topic.throttle_ms) for name, topic in config.topics]
        self.connection = RosbridgeConnection(config.url, clock, topics=topics, on_message=self._take)

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Be subscribed until ``stop`` is set. Raises `SourceError` without websocket-client."""
        for name, topic in self._config.topics:
            self._intakes[name] = Intake(name, topic, emit=emit, clock=self._clock)
        self.connection.run(stop)

    def report(self) -> dict[str, Any]:
        """What became of the messages, by topic."""
        return {name: intake.report() for name, intake in self._intakes.items()}

    def _take(self, topic: str, message: Any, arrival_us: int) -> None:
        self._intakes[topic].take(message, arrival_us)


class Intake:
    """One topic's messages, from JSON to samples."""

    def __init__(self, topic: str, config: TopicConfig, *, emit: Emit, clock: Clock) -> None:
        self._topic = topic
        self._config = config
        self._emit = emit
        self._seldom = Seldom(_log, clock)
        self._messages = 0

    def take(self, message: Any, arrival_us: int) -> None:
        """Take a message. Never raises."""
        self._messages += 1
        if not isinstance(message, SimpleNamespace):
            self._seldom.warn("malformed", f"topic {self._topic}: a message is {message!r:.60}, no object")
            return
        try:
            values = self._values(message)
        except (SourceError, RecursionError) as error:
            self._seldom.warn("refused", f"topic {self._topic}: {error}")
            return
        if not values:
            self._seldom.warn("empty", f"topic {self._topic}: there is no field in its messages to send")
            return
        t_us = arrival_us if self._config.time == ARRIVAL else self._stamp_us(message, arrival_us)
        self._emit(self._config.stream, t_us, values)

    def report(self) -> dict[str, Any]:
        """What became of the messages."""
        return {"messages": self._messages, **self._seldom.counts()}

    def _values(self, message: Any) -> dict[str, Value]:
        wanted = self._config.fields
        # What is selected may be an element of an array that is left out otherwise.
        values = flatten(message if wanted else _without_long(message), _fields_of)
        if wanted:
            chosen = {
                path: value
                for path, value in values.items()
                if any(path == name or path.startswith(f"{name}.") for name in wanted)
            }
            for name in wanted:
                if not any(path == name or path.startswith(f"{name}.") for path in chosen):
                    self._seldom.warn("missing", f"topic {self._topic}: its messages have no field {name}")
            values = chosen
        long = [path for path, value in values.items() if isinstance(value, str) and len(value) > _MAX_TEXT]
        for path in long:
            del values[path]
            self._seldom.warn("left_out", f"topic {self._topic}: {path} is too long a text and is left out")
        return values

    def _stamp_us(self, message: Any, arrival_us: int) -> int:
        """The header's stamp, or the arrival's time if there is none to believe."""
        stamp = getattr(getattr(message, HEADER_FIELD, None), "stamp", None)
        sec, nanosec = getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
        if type(sec) is not int or type(nanosec) is not int:
            why = "its messages have no header, so there is no time in them"
            self._seldom.warn("no_stamp", f"topic {self._topic}: {why}; using the time of arrival")
            return arrival_us
        stamp_us = sec * 1_000_000 + nanosec // 1000
        off_us = stamp_us - arrival_us
        if abs(off_us) < _BELIEVABLE_US:
            return stamp_us
        why = f"its stamps are {off_us / 1e6:.0f} s off the clock"
        self._seldom.warn("unbelieved_stamps", f"topic {self._topic}: {why}; using the time of arrival")
        return arrival_us


def _namespace(members: dict[str, Any]) -> SimpleNamespace:
    # ROS 1 names a time's parts as nobody else does.
    if members.keys() == {"secs", "nsecs"}:
        members = {"sec": members["secs"], "nanosec": members["nsecs"]}
    return SimpleNamespace(**members)


def _fields_of(value: Any) -> list[str] | None:
    return list(vars(value)) if isinstance(value, SimpleNamespace) else None


def _without_long(value: Any) -> Any:
    """The message without its long arrays, which are no telemetry."""
    if not isinstance(value, SimpleNamespace):
        return value
    return SimpleNamespace(
        **{
            name: _without_long(member)
            for name, member in vars(value).items()
            if not (isinstance(member, list) and len(member) > MAX_ELEMENTS)
        }
    )


def _load_websocket() -> Any:
    try:
        # Only a robot with rosbridge needs it: pip install iort[rosbridge].
        import websocket  # noqa: PLC0415 - optional
    except ImportError as error:
        raise SourceError(
            "rosbridge needs the package websocket-client: pip install 'iort[rosbridge]'"
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
