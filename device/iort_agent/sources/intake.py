"""One ROS topic's messages, of ROS 1 or 2, from their bytes to samples, wherever the bytes come from.

Messages are recorded as published, so that an export gives what was published, whatever the type is. Only
selected fields are decoded here. This module needs no ROS.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Dict, Mapping, NamedTuple, Optional

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.schema import choice, items, setting, text
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.ros.ros1_types import installed
from iort_agent.sources import REFUSE, UPLOAD, Emit
from iort_agent.sources.repeats import Latched
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.ros.decode import Decoder, Large, stamp_ns
from iort_contract.ros.definition import Definition, parse
from iort_contract.ros.message import MessageType, RosMessage, RosType
from iort_contract.topics import check_stream

_log = logging.getLogger(__name__)

HEADER, ARRIVAL, SOURCE = "header", "arrival", "source"
# A stamp further from the wall clock comes from a clock that is not set, or from a simulation.
BELIEVABLE_US = 3600 * 1_000_000
_SILENT_S = 5.0
# Messages that wait together, at most: the one that the live lane sends waits for those before it.
_TOGETHER = 16
# A message of this size costs so much that waiting for others saves nothing, and takes their memory.
_LARGE_BYTES = 65_536
# A message waits in the middleware while the agent is busy, but not longer.
_WAITED_US = 10_000_000
# A topic changes its definition when somebody rebuilds a package, not all the time.
_MAX_KINDS = 32
_MAX_PUBLISHERS = 32
# The MD5 of a type without fields, whose definition may be empty.
_MD5_OF_NOTHING = "d41d8cd98f00b204e9800998ecf8427e"


@dataclass(frozen=True)
class TopicConfig:
    """How a topic is recorded.

    ``time`` is required: ``header`` is the time of the measurement, by the clock of the computer that
    measured; ``arrival`` is the time of receipt, by the agent's clock. A message that a latching publisher
    repeats to a new connection is left out in all cases, and counted as ``latched_again``. ``fields`` are
    the wanted paths, or their beginnings (``pose.position``); without it, all.
    """

    time: str = setting(choice(HEADER, ARRIVAL))
    stream: str = setting(text(check_stream))
    fields: tuple[str, ...] | None = setting(
        items(text(), at_least=1, what="a list of at least one field"), default=None
    )


class Selected(Dict[str, Any]):
    """The selected fields of a message; ``whole`` is the message, for the event recorder, which takes it also
    if there are no fields. ``again`` marks a latched message that came before, which nobody else takes."""

    whole: RosMessage | None = None
    again = False


def _mark(values: Mapping[str, Value], latched_by: str, *, again: bool) -> None:
    """Note in a message that its publisher latches it."""
    message = values.whole if isinstance(values, Selected) else values
    if isinstance(values, Selected):
        values.again = again
    if isinstance(message, RosMessage):
        message.latched_by = latched_by


class Kind(NamedTuple):
    """A type of the topic's messages. ``decoder`` is for selected fields, and for bytes that are stored
    elsewhere."""

    whole: RosType
    text: str
    decoder: Optional[Decoder]  # noqa: UP045 - a NamedTuple's types are evaluated, on Python 3.8 too
    stamped: bool
    ros2: bool


class Intake:
    """Takes one topic's messages. Safe to use from several threads."""

    def __init__(
        self,
        topic: str,
        config: TopicConfig,
        *,
        emit: Emit,
        clock: Clock,
        large: str = REFUSE,
        latched: Latched | None = None,
        whole: bool = False,
    ) -> None:
        self.sim_time = False
        self.throttled = ThrottledLog(_log, clock)
        self._topic = topic
        self._config = config
        self._large = large == UPLOAD
        self._emit = emit
        self._whole = whole
        self._clock = clock
        self._header: Mapping[str, str] | None = None
        # Publisher -> its connection, whose type has been sent.
        self._connections: dict[str, Mapping[str, str]] = {}
        self._kind: Kind | None = None
        self._kinds: dict[tuple[str, str], Kind] = {}
        self._decoders: list[Decoder] = []
        self._latched = latched or Latched({})
        # Publisher -> the connection by which its last latched message came.
        self._latching: dict[str, Mapping[str, str]] = {}
        self._lock = threading.Lock()
        # What `receive` has got, and until when it may stay there.
        self._inbox: deque[tuple[Mapping[str, str], bytes, int, int]] = deque()
        self._inbox_lock = threading.Lock()
        self._due = 0.0
        self._messages = self._seen = 0
        self._heard = clock.monotonic()
        self._silent = False

    def receive(
        self, header: Mapping[str, str], data: bytes, source_ns: int = 0, received_ns: int = 0
    ) -> None:
        """Note a message that arrives now, or that the middleware received at ``received_ns``; ``source_ns``
        is when it was published. It is taken with those before it, when the live lane wants one:
        the first one after a pause costs as much as ten that follow it at once. Of a topic that falls silent,
        `look` takes them. Never raises."""
        arrival_us, received_us = self._clock.now_us(), received_ns // 1000
        if arrival_us - _WAITED_US < received_us < arrival_us:
            arrival_us = received_us
        self._inbox.append((header, data, arrival_us, source_ns))
        if len(self._inbox) >= _TOGETHER or self._clock.monotonic() >= self._due or len(data) > _LARGE_BYTES:
            self.take_received()

    def take_received(self) -> None:
        """Take what `receive` has got."""
        with self._inbox_lock:
            while self._inbox:
                header, data, arrival_us, source_ns = self._inbox.popleft()
                try:
                    self.take(header, data, arrival_us, source_ns, more=bool(self._inbox))
                except Exception:  # noqa: BLE001 - whatever it is, the others must be heard
                    # A failing disk or a full memory costs this message, and neither the topic nor others.
                    _log.exception("topic %s: a message could not be taken", self._topic)

    def take(
        self,
        header: Mapping[str, str],
        data: bytes,
        arrival_us: int | None = None,
        source_ns: int = 0,
        *,
        more: bool = False,
    ) -> None:
        """Take a message with the header of its connection; ``arrival_us`` is now unless given, and ``more``
        tells that others follow at once. Never raises."""
        if arrival_us is None:
            arrival_us = self._clock.now_us()
        latched_by = header.get("callerid", "") if header.get("latching") == "1" else None
        again = latched_by is not None and self._came_before(header, data, source_ns)
        if again:
            self.warn("latched_again", "a latched message came again; not sent")
            if not self._whole:
                return
        else:
            self._messages += 1
        # Two publishers of one topic are two threads; almost always there is one.
        with self._lock:
            if header is not self._header:
                self._turn_to(header, arrival_us)
            kind = self._kind
        assert kind is not None
        t_us = None
        time = self._config.time
        if time == SOURCE:
            t_us = source_ns // 1000 or None
        elif kind.stamped and time == HEADER:
            t_ns = stamp_ns(data, ros2=kind.ros2)
            t_us = None if t_ns is None else t_ns // 1000
        whole = kind.whole if kind.decoder is None else None
        if again:
            # The recorder may have begun since, and needs what is in force.
            values: Mapping[str, Value] | None = self._selected({}, kind, data, arrival_us)
        elif whole is not None:
            values = RosMessage(data, whole, arrival_us=arrival_us)
        else:
            values = self._sample(kind, data, arrival_us)
        if latched_by is not None and values is not None:
            _mark(values, latched_by, again=again)
        if t_us is None or self.sim_time or not -BELIEVABLE_US < t_us - arrival_us < BELIEVABLE_US:
            if time != ARRIVAL:
                self._warn_of_stamp(t_us, arrival_us)
            t_us = arrival_us
        if values is not None:
            self._due = self._emit(self._config.stream, t_us, values, more=more)

    def warn(self, reason: str, why: str) -> None:
        """Count and log something about the topic's messages."""
        self.throttled.warn(reason, f"topic {self._topic}: {why}")

    def look(self, connections: Callable[[], int]) -> None:
        """Take what waits, and log when the topic falls silent, and when it is heard again; several times a
        second."""
        now = self._clock.monotonic()
        if now >= self._due:
            self.take_received()
        if self._messages != self._seen:
            self._seen, self._heard = self._messages, now
            if self._silent:
                _log.info("topic %s is heard again", self._topic)
            self._silent = False
        elif not self._silent and now - self._heard >= _SILENT_S:
            self._silent = True
            count = connections()
            there = f"connected to {count} publisher(s)" if count else "nobody publishes it"
            _log.warning("topic %s has been silent for %g s: %s", self._topic, _SILENT_S, there)

    def report(self) -> dict[str, Any]:
        """The counts of the topic's messages."""
        left_out: dict[str, int] = {}
        # A message that is recorded whole has everything, whatever its view leaves out.
        for decoder in () if self._large and not self._config.fields else tuple(self._decoders):
            # A copy: threads that receive messages count meanwhile.
            for path, count in decoder.left_out.copy().items():
                left_out[path] = left_out.get(path, 0) + count
        counts = {"messages": self._messages, "silent": self._silent, "left_out": left_out}
        return {**counts, **self.throttled.counts()}

    def _decoder(self, kind: str, definition: Definition) -> Decoder:
        decoder = Decoder(definition, select=self._config.fields, large=self._large)
        if decoder.unknown:
            _log.warning("topic %s: %s has no field %s", self._topic, kind, ", ".join(decoder.unknown))
        self._decoders = [*self._decoders[-_MAX_KINDS:], decoder]
        return decoder

    def _sample(self, kind: Kind, data: bytes, arrival_us: int) -> Mapping[str, Value] | None:
        """The message, or the selected fields."""
        values: dict[str, Any] = {}
        if kind.decoder is not None:
            try:
                values = kind.decoder.decode(data)
            except MessageError as error:
                if self._config.fields:
                    self.warn("malformed", str(error))
                    return self._selected({}, kind, data, arrival_us)
                self.warn("undecodable", f"kept as it is: {error}")
        if kind.decoder is None or not self._config.fields:
            contents = {name: value for name, value in values.items() if isinstance(value, Large) and value}
            return RosMessage(data, kind.whole, large=contents, arrival_us=arrival_us)
        if not values:
            self.warn("empty", "its messages have no field to send")
        return self._selected(values, kind, data, arrival_us)

    def _selected(
        self, values: dict[str, Any], kind: Kind, data: bytes, arrival_us: int
    ) -> Mapping[str, Value] | None:
        """The fields, with the whole message if somebody takes it; None without both."""
        if not self._whole:
            return values or None
        selected = Selected(values)
        selected.whole = RosMessage(data, kind.whole, arrival_us=arrival_us)
        return selected

    def _came_before(self, header: Mapping[str, str], data: bytes, source_ns: int) -> bool:
        """Whether a latching publisher repeats the message to a new connection: old data, whatever its
        time."""
        publisher = header.get("callerid", "")
        with self._lock:
            if source_ns:
                return self._latched.came_before(str(source_ns), data)
            again = self._latched.came_before(publisher, data)
            connection = self._latching.get(publisher)
            if connection is None and len(self._latching) >= _MAX_PUBLISHERS:
                self._latching.clear()
            self._latching[publisher] = header
        return again and connection is not header

    def _turn_to(self, header: Mapping[str, str], t_us: int) -> None:
        """Take the messages of another connection, which may be a new one."""
        self._kind = kind = self._kind_of(header)
        self._header = header
        publisher = header.get("callerid", "")
        if self._connections.get(publisher) is header:
            return
        if len(self._connections) >= _MAX_PUBLISHERS:
            self._connections.clear()
        self._connections[publisher] = header
        named = header.get("type", ""), header.get("md5sum", "")
        message_type = MessageType(self._config.stream, self._topic, *named, kind.text)
        try:
            self._emit(TYPES_STREAM, t_us, message_type.sample())
        except ContractError as error:
            _log.warning("topic %s: its type is not recorded: %s", self._topic, error)

    def _kind_of(self, header: Mapping[str, str]) -> Kind:
        key = (header.get("type", ""), header.get("md5sum", ""))
        known, text = self._kinds.get(key), header.get("message_definition")
        # One of two publishers may have sent no definition, and the other sends it.
        if known is None or key[1] == "*" or (not known.text.strip() and text and text.strip()):
            if len(self._kinds) >= _MAX_KINDS:
                self._kinds.clear()
            self._kinds[key] = self._make_kind(*key, text)
        return self._kinds[key]

    def _make_kind(self, kind: str, md5sum: str, sent: str | None) -> Kind:
        decoder, stamped, why, ros2, text = None, False, "", "/msg/" in kind, sent or ""
        _log.info("topic %s: %s, %s", self._topic, kind, md5sum)
        try:
            # Some small clients send no definition; then only the installed class has it.
            if not text.strip() and md5sum != _MD5_OF_NOTHING and not ros2:
                text = installed(kind).text
            if sent is None and ros2:
                raise MessageError(f"the definition of {kind}, {md5sum}, is not installed")  # noqa: TRY301 - one way out
            definition = parse(kind, text)
            stamped = definition.stamped()
            if self._config.fields or self._large:
                decoder = self._decoder(kind, definition)
        except (MessageError, SourceError) as error:
            why = str(error)
        whole = RosType(self._topic, kind, md5sum, text)
        if why or whole.error:
            self.warn(
                "undecodable", f"its messages are kept, but cannot be looked into: {why or whole.error}"
            )
        return Kind(whole, text, decoder, stamped, ros2)

    def _warn_of_stamp(self, t_us: int | None, arrival_us: int) -> None:
        if t_us is None:
            reason, why = "no_stamp", "its messages have no time of their own"
        elif self.sim_time:
            reason, why = "unbelieved_stamps", "its time is a simulation's (use_sim_time)"
        else:
            off_s = (t_us - arrival_us) / 1e6
            reason, why = "unbelieved_stamps", f"its stamps are {off_s:.0f} s off the clock"
        self.warn(reason, f"{why}; using the time of arrival")
