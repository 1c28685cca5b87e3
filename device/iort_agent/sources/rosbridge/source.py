"""ROS topics over the rosbridge WebSocket protocol, which serves ROS 1 and ROS 2 robots alike.

JSON has no types, so they are asked of the server's rosapi, and each message is made the ROS 1 message that
it was; it then goes the way of the ROS 1 source. Where rosapi does not answer, a sample is made of the JSON,
as `iort_agent.sources.flatten` does, and counted as ``structure_not_kept``: a ``uint8[]`` is a text there,
arrays of more than `MAX_ELEMENTS` and texts that the contract would refuse are left out, unless they are what
`fields` selects, and a ROS 1 time is named as in ROS 2.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Mapping, Sequence
from urllib.parse import urlsplit

from iort_agent.clock import Clock
from iort_agent.errors import SourceError
from iort_agent.ros1.write import Writer
from iort_agent.schema import Where, choice, items, number, pairs, section, setting, text
from iort_agent.sources import Emit, ros1
from iort_agent.sources.flatten import HEADER as HEADER_FIELD
from iort_agent.sources.flatten import flatten
from iort_agent.sources.ros1 import ARRIVAL, BELIEVABLE_US, HEADER
from iort_agent.sources.rosbridge.connection import TIMES, RosbridgeConnection, Times, Topic
from iort_agent.sources.rosbridge.continuity import Numbers, Repeats
from iort_agent.sources.rosbridge.rosapi import AGAIN_S, Rosapi, Structure
from iort_agent.throttled_log import Seldom
from iort_contract.limits import MessageError, Value
from iort_contract.topics import check_stream

_log = logging.getLogger(__name__)

MAX_ELEMENTS = 64
_MAX_TEXT = 4096
# What is kept of a topic until its type is known.
_MAX_HELD, _MAX_HELD_BYTES = 2_000, 8_000_000


@dataclass(frozen=True)
class TopicConfig:
    """What becomes of a topic.

    ``type`` lets the server subscribe before anybody publishes. ``time`` must be said: ``header`` is when
    it was measured, by the clock of the computer that did; ``arrival`` is when the agent received it, by
    its own clock. ``fields`` are the paths wanted, or what they begin with (``pose.position``); without
    it, all. ``throttle_ms`` is the least time between messages, kept by the server.
    """

    stream: str = setting(text(check_stream))
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
    """Emits each message of the topics; the listener of its connection."""

    def __init__(self, config: RosbridgeConfig, clock: Clock, times: Times = TIMES) -> None:
        self._config = config
        self._clock = clock
        self._intakes: dict[str, Intake] = {}
        topics = [Topic(name, topic.type, topic.throttle_ms) for name, topic in config.topics]
        self.connection = RosbridgeConnection(config.url, clock, topics=topics, listener=self, times=times)
        self._rosapi = Rosapi(self.connection.send, self._found, clock)
        # Topic -> when its structure is asked for, once something has come; None while it is being asked for.
        self._ask_at: dict[str, float | None] = {}

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Be subscribed until ``stop`` is set. Raises `SourceError` without websocket-client."""
        for name, topic in self._config.topics:
            self._intakes[name] = Intake(name, topic, emit=emit, clock=self._clock)
        try:
            self.connection.run(stop)
        finally:
            for intake in self._intakes.values():
                intake.structure(None)

    def report(self) -> dict[str, Any]:
        """What became of the messages, by topic."""
        return {
            name: {**intake.report(), **self.connection.report(name)}
            for name, intake in self._intakes.items()
        }

    def connected(self) -> None:
        """Another server may know other types: they are asked for again."""
        self._rosapi.restart()
        for intake in self._intakes.values():
            intake.hold()
        self._ask_at = dict.fromkeys(self._intakes, 0.0)

    def subscribed(self, topic: str) -> None:
        """A topic has been subscribed to."""
        self._intakes[topic].subscribed()

    def message(self, topic: str, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message; whether it is a new one."""
        due = self._ask_at.get(topic)
        if due is not None and self._clock.monotonic() >= due:
            self._ask_at[topic] = None
            self._rosapi.ask(topic, dict(self._config.topics)[topic].type)
        return self._intakes[topic].take(message, data, arrival_us)

    def answer(self, said: Mapping[str, Any]) -> None:
        """Take an answer, which may be rosapi's."""
        self._rosapi.answer(said)

    def look(self) -> None:
        """Called once a second or so."""
        self._rosapi.look()

    def _found(self, topic: str, structure: Structure | None) -> None:
        if structure is None:
            self._ask_at[topic] = self._clock.monotonic() + AGAIN_S
        else:
            self._ask_at.pop(topic, None)
        self._intakes[topic].structure(structure)


class Intake:
    """One topic's messages, from JSON to samples."""

    def __init__(self, topic: str, config: TopicConfig, *, emit: Emit, clock: Clock) -> None:
        self._topic = topic
        self._config = config
        self._emit = emit
        self._clock = clock
        self._seldom = Seldom(_log, clock)
        self._repeats = Repeats()
        self._numbers = Numbers()
        self._messages = 0
        # What came before the structure is known; None where nothing is held.
        self._held: deque[tuple[Any, int]] | None = None
        self._held_bytes = 0
        self._writer: Writer | None = None
        self._structure: Structure | None = None
        self._header: Mapping[str, str] = {}
        self._ros1 = ros1.Intake(
            topic,
            ros1.TopicConfig(stream=config.stream, time=config.time, fields=config.fields),
            emit=emit,
            clock=clock,
        )

    def subscribed(self) -> None:
        """A subscription begins, with which a latched message may come again."""
        self._repeats.subscribed(self._clock.monotonic())

    def hold(self) -> None:
        """Keep the messages until `structure` says what they consist of."""
        self._held = deque() if self._held is None else self._held

    def take(self, message: Any, data: bytes, arrival_us: int) -> bool:
        """Take a message and the text that it came in; whether it is a new one. Never raises."""
        stamp = _header(message).get("stamp")
        stamped = isinstance(stamp, dict) and any(stamp.values())
        if self._repeats.came_before(data, self._clock.monotonic(), stamped=stamped):
            self._seldom.warn("latched_again", f"topic {self._topic}: a latched message came again; not sent")
            return False
        self._messages += 1
        if not isinstance(message, dict):
            self._seldom.warn("malformed", f"topic {self._topic}: a message is {message!r:.60}, no object")
            return True
        seq = _header(message).get("seq")
        if type(seq) is int and not self._config.throttle_ms:
            self._numbers.take(seq)
        if self._held is None:
            self._emit_message(message, arrival_us)
            return True
        self._held.append((message, arrival_us))
        self._held_bytes += len(data)
        if len(self._held) > _MAX_HELD or self._held_bytes > _MAX_HELD_BYTES:
            self.structure(None)
        return True

    def structure(self, structure: Structure | None) -> None:
        """What the messages consist of; None where that is not known, and what was known before holds."""
        if structure is not None and structure != self._structure:
            self._structure, self._writer = structure, Writer(structure.definition)
            self._header = {
                "type": structure.kind, "md5sum": structure.md5sum, "message_definition": structure.text,
            }  # fmt: skip
        held, self._held, self._held_bytes = self._held, None, 0
        for message, arrival_us in held or ():
            self._emit_message(message, arrival_us)

    def report(self) -> dict[str, Any]:
        """What became of the messages."""
        ros = {name: count for name, count in self._ros1.report().items() if count and name != "messages"}
        counts = {**ros, **self._seldom.counts()}
        if self._numbers.missed:
            counts["missed"] = self._numbers.missed
        return {"messages": self._messages, **counts}

    def _emit_message(self, message: dict[str, Any], arrival_us: int) -> None:
        data = self._bytes(message)
        if data is None:
            self._emit_flat(message, arrival_us)
            return
        self._ros1.take(self._header, data, arrival_us)

    def _bytes(self, message: dict[str, Any]) -> bytes | None:
        """The message as ROS 1 had it; None where its type is not known, or another."""
        writer = self._writer
        if writer is None:
            why = "the server does not say what its messages consist of"
        else:
            nulls = writer.nulls
            try:
                data = writer.write(message)
            except MessageError as error:
                why = str(error)
            else:
                if writer.nulls != nulls:
                    why = "the server sends null for NaN and the infinities; NaN is stored"
                    self._seldom.warn("not_a_number", f"topic {self._topic}: {why}")
                return data
        self._seldom.warn("structure_not_kept", f"topic {self._topic}: {why}; only single values are stored")
        return None

    def _emit_flat(self, message: dict[str, Any], arrival_us: int) -> None:
        try:
            values = self._values(message)
        except (SourceError, RecursionError) as error:
            self._seldom.warn("refused", f"topic {self._topic}: {error}")
            return
        if not values:
            self._seldom.warn("empty", f"topic {self._topic}: there is no field in its messages to send")
            return
        t_us = _stamp_us(message)
        if self._config.time == ARRIVAL or t_us is None or abs(t_us - arrival_us) >= BELIEVABLE_US:
            if self._config.time == HEADER:
                self._ros1.flag(t_us, arrival_us)
            t_us = arrival_us
        self._emit(self._config.stream, t_us, values)

    def _values(self, message: dict[str, Any]) -> dict[str, Value]:
        wanted = self._config.fields
        # What is selected may be an element of an array that is left out otherwise.
        values = flatten(message, _members if wanted else _short_members)
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


def _header(message: Any) -> dict[str, Any]:
    header = message.get(HEADER_FIELD) if isinstance(message, dict) else None
    return header if isinstance(header, dict) else {}


def _stamp_us(message: dict[str, Any]) -> int | None:
    """The header's stamp; None if it has none."""
    stamp = _members(_header(message).get("stamp")) or {}
    sec, nanosec = stamp.get("sec"), stamp.get("nanosec")
    if type(sec) is not int or type(nanosec) is not int:
        return None
    return sec * 1_000_000 + nanosec // 1000


def _members(value: Any) -> dict[str, Any] | None:
    """The fields of a message in JSON, as `flatten` takes them."""
    if not isinstance(value, dict):
        return None
    # Only ROS 1 has these names for the parts of a time.
    if value.keys() == {"secs", "nsecs"}:
        return {"sec": value["secs"], "nanosec": value["nsecs"]}
    return value


def _short_members(value: Any) -> dict[str, Any] | None:
    """As `_members`, without long arrays, which are no telemetry."""
    fields = _members(value)
    if fields is None:
        return None
    return {
        name: member
        for name, member in fields.items()
        if not (isinstance(member, list) and len(member) > MAX_ELEMENTS)
    }
