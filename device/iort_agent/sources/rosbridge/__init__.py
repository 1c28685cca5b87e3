"""ROS topics over the rosbridge WebSocket protocol, which serves ROS 1 and ROS 2 robots alike.

JSON has no types, so the server's rosapi is asked for them. Each message is made into the ROS 1 message that
it was, and goes the way of the ROS 1 source. Until rosapi answers, the newest messages of a topic are held.
"""

from __future__ import annotations

import socket
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Iterator, Mapping, Sequence
from urllib.parse import SplitResult, urlsplit

from iort_agent.common.schema import Place, number, pairs, section, setting, text
from iort_agent.common.threads import Clock
from iort_agent.ros.json_message import Writer
from iort_agent.sources import FAIL, OK, Emit, Finding, SourceConfig, intake
from iort_agent.sources.intake import Intake
from iort_agent.sources.rosbridge.connection import TIMES, RosbridgeConnection, Times, Topic
from iort_agent.sources.rosbridge.rosapi import AGAIN_S, Rosapi, Structure
from iort_contract.limits import MessageError

# A latched message comes with the subscription, or not at all.
_AGAIN_S = 10.0
# A topic has few latching publishers; each holds one message.
_RECENT = 16


class Repeats:
    """Recognizes the latched message that a server repeats with every subscription.

    It equals one of the last messages, word for word. A message without a stamp may be equal and new, like a
    switch that says "on" every second; so on a topic that repeats itself at other times, it counts as new.
    """

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._again: set[int] = set()
        self._until = 0.0
        self._repeats_itself = False

    def subscribed(self, now: float) -> None:
        """A subscription begins, at that time of the monotonic clock."""
        self._again = set(self._recent)
        self._until = now + _AGAIN_S

    def came_before(self, data: bytes, now: float, *, stamped: bool) -> bool:
        """Whether the server had sent the message before the subscription began."""
        digest = hash(data)
        if self._again and now >= self._until:
            self._again.clear()
        if digest in self._again:
            self._again.discard(digest)
            if stamped or not self._repeats_itself:
                return True
        elif digest in self._recent:
            self._repeats_itself = True
        self._recent.append(digest)
        return False


# Messages of a topic that are held until its type is known.
_MAX_HELD, _MAX_HELD_BYTES = 2_000, 8_000_000
_CHECK_S = 5.0


@dataclass(frozen=True)
class TopicConfig(intake.TopicConfig):
    """How a topic is recorded. ``type`` lets the server subscribe before anybody publishes; ``throttle_ms``
    is the shortest time between messages, kept by the server."""

    type: str | None = setting(text(), default=None)
    throttle_ms: int = setting(number(0, 3_600_000, whole=True, unit="ms"), 0)


def _websocket_url(value: Any, where: Place) -> str:
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
class RosbridgeConfig(SourceConfig):
    """Topics of a rosbridge server."""

    url: str = setting(_websocket_url)
    topics: tuple[tuple[str, TopicConfig], ...] = setting(
        pairs(section(TopicConfig), what="a mapping of ROS topic to its stream and time")
    )

    def streams(self) -> Sequence[str]:
        return sorted({topic.stream for _, topic in self.topics})

    def describe(self) -> str:
        return f"rosbridge {self.url}, topics {', '.join(topic for topic, _ in self.topics)}"

    def build(self, clock: Clock) -> RosbridgeSource:
        return RosbridgeSource(self, clock)

    def check(self, title: str) -> Iterator[Finding]:
        """Whether somebody listens at the address."""
        parts: SplitResult = urlsplit(self.url)
        try:
            port = parts.port or (443 if parts.scheme == "wss" else 80)
            socket.create_connection((parts.hostname or "", port), _CHECK_S).close()
        except OSError as error:
            yield Finding(title, FAIL, f"{self.url}: {error}", "start rosbridge_server there")
        else:
            yield Finding(title, OK, f"{self.url} listens")


class RosbridgeSource:
    """Emits each message of the topics; the listener of its connection."""

    def __init__(self, config: RosbridgeConfig, clock: Clock, times: Times = TIMES) -> None:
        self._config = config
        self._clock = clock
        # Whether somebody takes whole messages, whatever is selected of them.
        self.whole = False
        self._hearings: dict[str, _Hearing] = {}
        topics = [Topic(name, topic.type, topic.throttle_ms) for name, topic in config.topics]
        self.connection = RosbridgeConnection(config.url, clock, topics=topics, listener=self, times=times)
        self._rosapi = Rosapi(self.connection.send, self._found, clock)
        # Topic -> the time to ask for its structure, once a message comes; None while it is being asked for.
        self._ask_at: dict[str, float | None] = {}

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Subscribe until ``stop`` is set. Raises `SourceError` without websocket-client."""
        for name, topic in self._config.topics:
            taken = Intake(name, topic, emit=emit, clock=self._clock, whole=self.whole)
            self._hearings[name] = _Hearing(taken, self._clock)
        self.connection.run(stop)

    def report(self) -> dict[str, Any]:
        return {
            name: {**hearing.report(), **self.connection.report(name)}
            for name, hearing in self._hearings.copy().items()
        }

    def connected(self) -> None:
        """Ask for the types again, since another server may know others."""
        self._rosapi.restart()
        for hearing in self._hearings.values():
            hearing.hold()
        self._ask_at = dict.fromkeys(self._hearings, 0.0)

    def subscribed(self, topic: str) -> None:
        """A subscription begins, with which a latched message may come again."""
        self._hearings[topic].repeats.subscribed(self._clock.monotonic())

    def message(self, topic: str, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message; whether it is a new one."""
        due = self._ask_at.get(topic)
        if due is not None and self._clock.monotonic() >= due:
            self._ask_at[topic] = None
            self._rosapi.ask(topic, dict(self._config.topics)[topic].type)
        return self._hearings[topic].take(message, data, arrival_us)

    def answer(self, said: Mapping[str, Any]) -> None:
        self._rosapi.answer(said)

    def look(self) -> None:
        self._rosapi.look()

    def _found(self, topic: str, structure: Structure | None) -> None:
        if structure is None:
            self._ask_at[topic] = self._clock.monotonic() + AGAIN_S
        else:
            self._ask_at.pop(topic, None)
        self._hearings[topic].structure(structure)


class _Hearing:
    """One topic's messages, from JSON to the bytes that its intake takes."""

    def __init__(self, taken: Intake, clock: Clock) -> None:
        self.repeats = Repeats()
        self._intake = taken
        self._clock = clock
        self._messages = 0
        # The messages that wait for the structure, with the sizes of their texts.
        self._held: deque[tuple[dict[str, Any], int, int]] = deque()
        self._held_bytes = 0
        # None until the server that is connected now has told the structure.
        self._writer: Writer | None = None
        self._structure: Structure | None = None
        self._header: Mapping[str, str] = {}

    def hold(self) -> None:
        """Hold the messages until `structure` is called."""
        self._writer = None

    def take(self, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message and its text; whether it is a new one. Never raises."""
        header = message.get("header") if isinstance(message, dict) else None
        header = header if isinstance(header, dict) else {}
        stamp = header.get("stamp")
        stamped = isinstance(stamp, dict) and any(stamp.values())
        if self.repeats.came_before(data, self._clock.monotonic(), stamped=stamped):
            self._intake.warn("latched_again", "a latched message came again; not sent")
            return False
        self._messages += 1
        if not isinstance(message, dict):
            self._intake.warn("malformed", f"a message must be an object, got {message!r:.60}")
            return True
        if self._writer is not None:
            self._record(self._writer, message, arrival_us)
            return True
        self._held.append((message, arrival_us, len(data)))
        self._held_bytes += len(data)
        while len(self._held) > _MAX_HELD or self._held_bytes > _MAX_HELD_BYTES:
            self._held_bytes -= self._held.popleft()[2]
            self._intake.warn("type_unknown", "rosapi, which runs beside the server, does not tell its type")
        return True

    def structure(self, structure: Structure | None) -> None:
        """Record the messages that were held, and those to come. None if rosapi does not tell the structure:
        the one of the connection before stays."""
        structure = structure or self._structure
        if structure is None:
            return
        if structure != self._structure:
            self._structure = structure
            self._header = {
                "type": structure.kind, "md5sum": structure.md5sum, "message_definition": structure.text,
            }  # fmt: skip
        self._writer = writer = Writer(structure.definition)
        while self._held:
            message, arrival_us, _ = self._held.popleft()
            self._record(writer, message, arrival_us)
        self._held_bytes = 0

    def report(self) -> dict[str, Any]:
        counts = {name: count for name, count in self._intake.report().items() if count}
        if self._held:
            counts["type_unknown"] = counts.get("type_unknown", 0) + len(self._held)
        return {**counts, "messages": self._messages}

    def _record(self, writer: Writer, message: dict[str, Any], arrival_us: int) -> None:
        nulls = writer.nulls
        try:
            data = writer.write(message)
        except MessageError as error:
            self._intake.warn("malformed", str(error))
            return
        if writer.nulls != nulls:
            why = "the server sends null for NaN and the infinities; NaN is stored"
            self._intake.warn("not_a_number", why)
        self._intake.take(self._header, data, arrival_us)
