"""A node in a ROS 1 graph: any topic, of any message type, whose class need not be installed.

The publisher sends its message's definition when it connects. Messages are recorded as they came, so that
whatever the type is, what is exported is what was published; only a selection of fields is decoded here.
"""

from __future__ import annotations

import logging
import re
import threading
from dataclasses import dataclass
from typing import Any, Mapping, NamedTuple, Optional, Sequence

from iort_agent.clock import Clock
from iort_agent.errors import SourceError
from iort_agent.ros1.node import ANY_TYPE, DEFAULT_NODE, Node, definition_of, shared
from iort_agent.schema import Where, choice, items, pairs, section, setting, text
from iort_agent.sources import REFUSE, UPLOAD, Emit
from iort_agent.throttled_log import Seldom
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.messages.message_type import MessageType
from iort_contract.ros1.decode import HEADER as HEADER_STRUCT
from iort_contract.ros1.decode import Decoder
from iort_contract.ros1.definition import parse
from iort_contract.ros1.message import RosMessage, RosType
from iort_contract.topics import check_stream

_log = logging.getLogger(__name__)

HEADER, ARRIVAL = "header", "arrival"
# A stamp that is further from the wall clock comes from a clock that is not set, or from a simulation.
BELIEVABLE_US = 3600 * 1_000_000
_SILENT_S = 5.0
_LOOK_S = 1.0
# A topic changes its definition when somebody rebuilds a package, not all the time.
_MAX_KINDS = 32
_MAX_PUBLISHERS = 32
# Of a type without fields, whose definition is rightly empty.
_MD5_OF_NOTHING = "d41d8cd98f00b204e9800998ecf8427e"

_ROS_NAME = re.compile(r"(/[A-Za-z]\w*)(/\w+)*", re.ASCII)


def ros_name(value: str) -> str:
    """The full name of a topic. Raises `ContractError` for what is none."""
    if not _ROS_NAME.fullmatch(value):
        raise ContractError(f"ROS topic {value!r}: allowed is a full name such as /sensors/core")
    return value


def _node_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z]\w*", value, re.ASCII):
        raise ContractError(f"ROS node {value!r}: allowed is a letter, then letters, digits and _")
    return value


@dataclass(frozen=True)
class TopicConfig:
    """What becomes of a topic.

    ``time`` must be said: ``header`` is when it was measured, by the clock of the computer that did;
    ``arrival`` is when the agent received it, by its own clock. What a latching publisher repeats to a
    new connection is left out with either, and counted as ``latched_again``. ``fields`` are the paths
    wanted, or what they begin with (``pose.position``); without it, all. ``large: upload`` sends bytes
    (images, point clouds) as files, otherwise they are left out.
    """

    stream: str = setting(text(check_stream))
    time: str = setting(choice(HEADER, ARRIVAL))
    fields: tuple[str, ...] | None = setting(
        items(text(), at_least=1, what="a list of at least one field"), default=None
    )
    large: str = setting(choice(REFUSE, UPLOAD), REFUSE)


def _topics(value: Any, where: Where) -> Any:
    rule = pairs(section(TopicConfig), what="a mapping of ROS topic to its stream and time")
    for topic in value if isinstance(value, dict) else ():
        text(ros_name)(topic, where)
    return rule(value, where)


@dataclass(frozen=True)
class Ros1Config:
    """Topics of the ROS 1 graph whose master the environment's ROS_MASTER_URI names."""

    topics: tuple[tuple[str, TopicConfig], ...] = setting(_topics)
    node: str = setting(text(_node_name), DEFAULT_NODE)

    def streams(self) -> Sequence[str]:
        """The streams named; several topics may share one."""
        return sorted({topic.stream for _, topic in self.topics})

    def describe(self) -> str:
        """The source in a few words."""
        return f"ROS 1 topics {', '.join(topic for topic, _ in self.topics)}"

    def build(self, clock: Clock) -> Ros1Source:
        """Make the source; rospy is looked for when it runs."""
        return Ros1Source(self, clock)


class Ros1Source:
    """Emits each message of the topics, in the threads that receive them."""

    def __init__(self, config: Ros1Config, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._intakes: dict[str, Intake] = {}
        self._node: Node | None = None

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Be subscribed until ``stop`` is set. Raises `SourceError` without rospy, or if the node ends."""
        node = self._node = shared(self._config.node, self._clock)
        try:
            for topic, settings in self._config.topics:
                intake = Intake(node.resolve(topic), settings, emit=emit, clock=self._clock)
                self._intakes[topic] = intake
                node.subscribe(node.resolve(topic), intake.take)
            node.start()
            while not self._clock.wait(stop, _LOOK_S):
                if node.failed:
                    raise SourceError(node.failed)
                for topic, intake in self._intakes.items():
                    intake.sim_time = node.sim_time
                    if node.ready.is_set():
                        intake.look(node.connections(node.resolve(topic)))
        finally:
            for topic, intake in self._intakes.items():
                node.unsubscribe(node.resolve(topic), intake.take)
            node.release()

    def report(self) -> dict[str, Any]:
        """What became of the messages, by topic, and why the node waits, if it does."""
        waits = self._node.waits if self._node is not None else None
        topics = {topic: intake.report() for topic, intake in self._intakes.items()}
        return {**topics, "waits": waits} if waits is not None else topics


class Intake:
    """One topic's messages, from bytes to samples. Knows nothing of rospy."""

    def __init__(self, topic: str, config: TopicConfig, *, emit: Emit, clock: Clock) -> None:
        self.sim_time = False
        self._topic = topic
        self._config = config
        self._emit = emit
        self._clock = clock
        self._seldom = Seldom(_log, clock)
        self._header: Mapping[str, str] | None = None
        # Publisher -> its connection, whose messages' type was said.
        self._connections: dict[str, Mapping[str, str]] = {}
        self._kind: _Kind | None = None
        self._kinds: dict[tuple[str, str], _Kind] = {}
        # Publisher -> its connection, and the last message that came by it.
        self._latched: dict[str, tuple[Mapping[str, str], bytes]] = {}
        self._lock = threading.Lock()
        self._messages = self._seen = 0
        self._heard = clock.monotonic()
        self._silent = False

    def take(self, header: Mapping[str, str], data: bytes, arrival_us: int | None = None) -> None:
        """Take a message with the header of the connection that it came by; it came now, unless said. Never
        raises."""
        if arrival_us is None:
            arrival_us = self._clock.now_us()
        if header.get("latching") == "1" and self._came_before(header, data):
            self._seldom.warn("latched_again", f"topic {self._topic}: a latched message came again; not sent")
            return
        self._messages += 1
        # Two publishers of one topic are two threads; almost always there is one.
        with self._lock:
            if header is not self._header:
                self._turn_to(header, arrival_us)
            kind = self._kind
        assert kind is not None
        t_us, values = self._sample(kind, data)
        if t_us is None or self.sim_time or not -BELIEVABLE_US < t_us - arrival_us < BELIEVABLE_US:
            if self._config.time == HEADER:
                self.flag(t_us, arrival_us)
            t_us = arrival_us
        if values is None:
            return
        self._emit(self._config.stream, t_us, values)

    def _sample(self, kind: _Kind, data: bytes) -> tuple[int | None, Mapping[str, Value] | None]:
        """The header's stamp, if it has one, and the sample: the message, or what is selected of it."""
        stamp_us = None
        if kind.stamped and len(data) >= HEADER_STRUCT.size:
            _, sec, nanosec, _ = HEADER_STRUCT.unpack_from(data)
            # Wholes and remainders apart, for a float of seconds would lose the last digits.
            stamp_us = sec * 1_000_000 + nanosec // 1000
        if self._config.time == ARRIVAL:
            stamp_us = None
        if kind.decoder is None:
            return stamp_us, RosMessage(data, kind.whole)
        try:
            values = kind.decoder.decode(data)[0]
        except MessageError as error:
            if not self._config.fields:
                self._seldom.warn("undecodable", f"topic {self._topic}: kept as it is: {error}")
                return stamp_us, RosMessage(data, kind.whole)
            self._seldom.warn("malformed", f"topic {self._topic}: {error}")
            return stamp_us, None
        if not self._config.fields:
            found: Mapping[str, Any] = values
            contents = {name: value for name, value in found.items() if isinstance(value, bytes) and value}
            return stamp_us, RosMessage(data, kind.whole, large=contents)
        if not values:
            self._seldom.warn("empty", f"topic {self._topic}: there is no field in its messages to send")
            return stamp_us, None
        return stamp_us, values

    def _came_before(self, header: Mapping[str, str], data: bytes) -> bool:
        """Whether it is what a latching publisher sends with every connection, and is known from the
        connection before: old data, whatever its time."""
        publisher = header.get("callerid", "")
        with self._lock:
            connection, last = self._latched.get(publisher, (header, b""))
            if publisher not in self._latched and len(self._latched) >= _MAX_PUBLISHERS:
                self._latched.clear()
            self._latched[publisher] = header, data
        return connection is not header and last == data

    def _turn_to(self, header: Mapping[str, str], t_us: int) -> None:
        """Decode the messages of another connection, which may be a new one."""
        self._kind = self._kind_of(header)
        self._header = header
        publisher = header.get("callerid", "")
        if self._connections.get(publisher) is not header:
            if len(self._connections) >= _MAX_PUBLISHERS:
                self._connections.clear()
            self._connections[publisher] = header
            self._say_type(header, t_us)

    def _say_type(self, header: Mapping[str, str], t_us: int) -> None:
        """Say what the messages are, whenever a publisher connects."""
        assert self._kind is not None
        kind, md5sum = header.get("type", ""), header.get("md5sum", "")
        said = MessageType(self._config.stream, self._topic, kind, md5sum, self._kind.text)
        try:
            self._emit(TYPES_STREAM, t_us, said.sample())
        except ContractError as error:
            _log.warning("topic %s: its type is not recorded: %s", self._topic, error)

    def look(self, connections: int) -> None:
        """Say it when the topic falls silent, and when it is heard again."""
        now = self._clock.monotonic()
        if self._messages != self._seen:
            self._seen, self._heard = self._messages, now
            if self._silent:
                _log.info("topic %s is heard again", self._topic)
            self._silent = False
        elif not self._silent and now - self._heard >= _SILENT_S:
            self._silent = True
            there = f"connected to {connections} publisher(s)" if connections else "nobody publishes it"
            _log.warning("topic %s has been silent for %g s: %s", self._topic, _SILENT_S, there)

    def report(self) -> dict[str, Any]:
        """What became of the messages."""
        left_out: dict[str, int] = {}
        # A message that is recorded whole has everything, whatever its view leaves out.
        for kind in list(self._kinds.values()) if self._config.fields else ():
            for path, count in kind.decoder.left_out.items() if kind.decoder is not None else ():
                left_out[path] = left_out.get(path, 0) + count
        return {
            "messages": self._messages,
            "silent": self._silent,
            "left_out": left_out,
            **self._seldom.counts(),
        }

    def flag(self, t_us: int | None, arrival_us: int) -> None:
        """Count and log that the time of arrival is used, as the header's stamp is missing or wrong."""
        if t_us is None:
            reason, why = "no_stamp", "its messages have no header, so there is no time in them"
        elif self.sim_time:
            reason, why = "unbelieved_stamps", "its time is a simulation's (/use_sim_time)"
        else:
            off = (t_us - arrival_us) / 1e6
            reason, why = "unbelieved_stamps", f"its stamps are {off:.0f} s off the clock"
        self._seldom.warn(reason, f"topic {self._topic}: {why}; using the time of arrival")

    def _kind_of(self, header: Mapping[str, str]) -> _Kind:
        key = (header.get("type", ""), header.get("md5sum", ""))
        known, text = self._kinds.get(key), header.get("message_definition", "")
        # Of two publishers one may have sent no definition, and the other does.
        if known is None or key[1] == ANY_TYPE or (not known.text.strip() and text.strip()):
            if len(self._kinds) >= _MAX_KINDS:
                self._kinds.clear()
            self._kinds[key] = self._made(*key, text)
        return self._kinds[key]

    def _made(self, kind: str, md5sum: str, text: str) -> _Kind:
        config = self._config
        decoder, stamped = None, False
        try:
            # Some small clients send no definition; then only an installed class can tell.
            said = text.strip() or md5sum == _MD5_OF_NOTHING
            if said:
                definition = parse(kind, text)
            else:
                definition, installed = definition_of(kind)
                text = installed._full_text  # noqa: SLF001 - rospy's own name for it
            stamped = definition.stamped()
            if config.fields or config.large == UPLOAD:
                decoder = Decoder(definition, select=config.fields, large=config.large == UPLOAD)
        except MessageError:
            pass  # the type itself says what is wrong with it
        except SourceError as error:
            why = f"topic {self._topic}: its messages are kept, but cannot be looked into: {error}"
            self._seldom.warn("undecodable", why)
        _log.info("topic %s: %s, %s", self._topic, kind, md5sum)
        if decoder is not None and decoder.unknown:
            unknown = ", ".join(decoder.unknown)
            _log.warning("topic %s: %s has no field %s", self._topic, kind, unknown)
        whole = RosType(self._topic, kind, md5sum, text)
        if whole.error:
            why = f"topic {self._topic}: its messages are kept, but cannot be looked into: {whole.error}"
            self._seldom.warn("undecodable", why)
        return _Kind(whole, text, decoder, stamped=stamped)


class _Kind(NamedTuple):
    """A type of the topic's messages and its definition; ``decoder`` where fields are selected, or bytes kept
    elsewhere."""

    whole: RosType
    text: str
    decoder: Optional[Decoder]  # noqa: UP045 - a NamedTuple's types are evaluated, on Python 3.8 too
    stamped: bool
