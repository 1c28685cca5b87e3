"""Makes samples of the messages in bags of ROS 1 and ROS 2: each message as it was recorded.

A topic that cannot be read is left out, by name, and so is a message; the others are given. What was read is
compared with what the recording says that it holds.
"""

from __future__ import annotations

import hashlib
import logging
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import AbstractSet, Any, Iterator, Mapping, NamedTuple, Optional, Sequence, Tuple

from iort_contract.catalog.streams import CATALOG, TYPES_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.recordings import Message, RecordingError
from iort_contract.recordings.files import INDEX, Reader, library, wrapped
from iort_contract.recordings.scan import Scan
from iort_contract.ros.decode import Decoder, Large, stamp_ns
from iort_contract.ros.definition import RULE, parse
from iort_contract.ros.message import MessageType, RosMessage, RosType
from iort_contract.topics import stream_of

_log = logging.getLogger(__name__)

VESC_TYPE = "vesc_msgs/msg/VescStateStamped"
# A header stamp this far from the time of recording comes from a clock that is not set, or a simulation.
BELIEVABLE_NS = 3600 * 1_000_000_000


# What ROS and its tools tell of themselves.
_OWN = re.compile(
    r"/(rosout|rosout_agg|parameter_events|clock|client_count|connected_clients|diagnostics_agg)"
    r"|.*/(parameter_descriptions|parameter_updates|bond|transition_event)"
)


def is_ros_own(topic: str) -> bool:
    """Whether ROS and its tools tell of themselves on a topic, or its name is hidden."""
    return _OWN.fullmatch(topic) is not None or "/_" in topic


def stream_for(topic: str, kind: str, taken: AbstractSet[str]) -> str:
    """A name for the stream of a topic that is free."""
    if _named(kind) == VESC_TYPE and VESC_STREAM not in taken:
        return VESC_STREAM
    name = stream_of(topic)
    # Streams with known fields have these names.
    return f"topic-{name}" if name in CATALOG else name


class Kind(NamedTuple):
    """A topic's stream, the type of its messages, and the sample that declares it."""

    stream: str
    whole: RosType
    sample: Optional[Mapping[str, Value]]  # noqa: UP045 - evaluated, on Python 3.8 too
    stamped: bool
    large: Optional[Decoder]  # noqa: UP045 - as above


class Unread:
    """What recordings hold and could not give, by topic: ``counts`` of messages, ``lines`` for a person."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.lines: dict[str, str] = {}

    def add(self, topic: str, count: int, line: str) -> None:
        """Count messages of a topic, and log its first line."""
        self.counts[topic] += max(0, count)
        if topic not in self.lines:
            self.lines[topic] = line
            _log.warning("%s", line)


class Recording:
    """A bag, open for reading. The library's errors come as `RecordingError`.

    ``unread`` is complete once all messages were given.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[tuple[str, str]] | None,
        stream: str,
        unread: Unread,
        *,
        large: bool = False,
        reader: Reader | Scan | None = None,
    ) -> None:
        self._path = path
        self._topics = topics
        self._stream = stream
        self._unread = unread
        self._large = large
        self._reader: Any = Reader(path) if reader is None else reader
        self._kinds: dict[_Key, Kind] = {}

    def __enter__(self) -> Iterator[Message]:
        return self._messages(self.open())

    def open(self) -> Mapping[str, str]:
        """Open the files; returns the stream of each topic that can be read. Raises `RecordingError`."""
        self._reader.open()
        try:
            return self._streams()
        except RecordingError:
            self._reader.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def _streams(self) -> dict[str, str]:
        """Wanted ROS topic -> stream, of the topics that can be read. Raises `RecordingError`."""
        there = {c.topic: _named(c.msgtype) for c in self._reader.connections}
        wanted = dict(self._topics or [(t, self._stream) for t, kind in there.items() if kind == VESC_TYPE])
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items())) or "no topic"
        missing = [topic for topic in wanted if topic not in there]
        if missing:
            raise RecordingError(f"{self._path}: no topic {', '.join(missing)}; the recording has {listed}")
        if not wanted:
            raise RecordingError(
                f"{self._path}: no topic of type {VESC_TYPE}, so `topics` must name some, such as "
                f"`topics: {{/scan: scan}}`; the recording has {listed}"
            )
        counts = self._reader.counts()
        for connection in self._reader.connections:
            topic = connection.topic
            if topic not in wanted:
                continue
            try:
                self._kinds[_key(connection)] = self._kind(wanted[topic], connection)
            except RecordingError as error:
                del wanted[topic]
                self._unread.add(topic, counts[INDEX][topic], str(error))
        if not wanted:
            raise RecordingError("; ".join(self._unread.lines.values()))
        for topic in wanted:
            there_by = {place: topics.get(topic, 0) for place, topics in counts.items()}
            if len(set(there_by.values())) > 1:
                listed = ", ".join(f"{place} has {count:,} messages" for place, count in there_by.items())
                lost = max(there_by.values()) - there_by[INDEX]
                self._unread.add(topic, lost, f"{self._path}: topic {topic}: {listed}")
        return wanted

    def _messages(self, streams: Mapping[str, str]) -> Iterator[Message]:
        """The messages of these topics, in the order of recording."""
        start_ns = self._reader.start_ns
        begun: set[str] = set()
        for kind, recorded_ns, raw in self.raw(streams):
            at_ns = recorded_ns - start_ns
            measured_ns = self._measured_ns(kind, raw, recorded_ns) if kind.stamped else recorded_ns
            if kind.whole.id not in begun and kind.sample is not None:
                yield Message(TYPES_STREAM, at_ns, measured_ns, kind.sample)
            begun.add(kind.whole.id)
            contents: dict[str, Any] = {}
            if kind.large is not None:
                with suppress(MessageError):
                    values: dict[str, Any] = dict(kind.large.decode(raw))
                    contents = {name: v for name, v in values.items() if isinstance(v, Large) and v}
            yield Message(kind.stream, at_ns, measured_ns, RosMessage(raw, kind.whole, large=contents))

    def raw(self, streams: Mapping[str, str]) -> Iterator[tuple[Kind, int, bytes]]:
        """The messages of these topics as they are: their kind, the time of recording, and the bytes."""
        counts, read = self._reader.counts()[INDEX], Counter()  # type: Mapping[str, int], Counter[str]
        # The library gives one object for all messages of a connection.
        kinds: dict[int, tuple[Any, Kind, list[int]]] = {}
        for connection, recorded_ns, raw in self._reader.messages(lambda c: c.topic in streams):
            known = kinds.get(id(connection))
            if known is None:
                # The connection, too: another object could get its id.
                known = kinds[id(connection)] = connection, self._kinds[_key(connection)], [0]
            known[2][0] += 1
            yield known[1], recorded_ns, raw
        for connection, _, (count,) in kinds.values():
            read[connection.topic] += count
        for topic in streams:
            if read[topic] != counts[topic]:
                self._unread.add(
                    topic,
                    counts[topic] - read[topic],
                    f"{self._path}: topic {topic}: {read[topic]:,} messages were read, {INDEX} has "
                    f"{counts[topic]:,}",
                )

    def _kind(self, stream: str, connection: Any) -> Kind:
        name = _named(connection.msgtype)
        kind = name if self._reader.ros2(connection) else name.replace("/msg/", "/")
        with wrapped(f"{self._path}: topic {connection.topic}: its type {kind} cannot be read"):
            text = self._definition(connection, name)
            definition = parse(kind, text)
        digest = self._reader.type_hash(connection)
        digest = digest or f"sha256_{hashlib.sha256(text.encode()).hexdigest()}"
        sample = None
        try:
            sample = MessageType(stream, connection.topic, kind, digest, text).sample()
        except ContractError as error:
            _log.warning("%s: topic %s: %s", self._path, connection.topic, error)
        large = Decoder(definition, large=True) if self._large else None
        return Kind(
            stream, RosType(connection.topic, kind, digest, text), sample, definition.stamped(), large
        )

    def _measured_ns(self, kind: Kind, raw: bytes, recorded_ns: int) -> int:
        """The header stamp, or the time of recording if the stamp is missing or not believable."""
        t_ns = stamp_ns(raw, ros2=kind.whole.ros2)
        return t_ns if t_ns is not None and abs(t_ns - recorded_ns) < BELIEVABLE_NS else recorded_ns

    def _definition(self, connection: Any, name: str) -> str:
        """The definition as recorded, with constants and comments; of IDL, or of a type that the recording
        does not define, the library's text."""
        # rosbags for Python 3.8 has the text itself, and no format beside it.
        text: str = getattr(connection.msgdef, "data", connection.msgdef)
        form = getattr(getattr(connection.msgdef, "format", None), "name", "MSG" if text else "NONE")
        is_idl = form == "IDL" or text.startswith(_IDL)
        if not self._reader.ros2(connection) or (form != "NONE" and not is_idl):
            return text
        typesys = library("typesys")
        store = typesys.get_typestore(typesys.Stores.EMPTY) if is_idl else _known_types()
        if is_idl:
            parts = [part.partition("\n")[2] for part in text.split(f"{RULE}\n")[1:]]
            for part in parts if text.startswith(_IDL) else [text]:
                store.register(typesys.get_types_from_idl(part))
        # Renamed between the versions for Python 3.8 and later.
        if name not in (store.fielddefs if hasattr(store, "fielddefs") else store.FIELDDEFS):
            raise RecordingError(
                f"{self._path}: the topic {connection.topic} is of type {name}, whose definition is neither "
                "in the recording nor known; `ros2 bag convert` into MCAP adds it"
            )
        generated: str = store.generate_msgdef(name, ros_version=2)[0]
        return generated


# One name may have two definitions, each with its own connection. Not every format has hashes of them.
_Key = Tuple[str, str, str, object]


def _key(connection: Any) -> _Key:
    return connection.topic, connection.msgtype, connection.digest, connection.msgdef


def _named(msgtype: str) -> str:
    """The type's name as the library has it. Some recorders leave out the middle."""
    package, _, name = msgtype.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else msgtype


_IDL = f"{RULE}\nIDL: "

# vesc_msgs for ROS 2, since recordings of Foxy and Humble hold no definitions. The order is the wire's.
VESC_STATE_ROS2 = """
float64 temp_fet
float64 temp_motor
float64 current_motor
float64 current_input
float64 avg_id
float64 avg_iq
float64 duty_cycle
float64 speed
float64 voltage_input
float64 charge_drawn
float64 charge_regen
float64 energy_drawn
float64 energy_regen
int32 displacement
int32 distance_traveled
int32 fault_code
float64 pid_pos_now
int32 controller_id
float64 ntc_temp_mos1
float64 ntc_temp_mos2
float64 ntc_temp_mos3
float64 avg_vd
float64 avg_vq
"""


def _known_types() -> Any:
    """The types of ROS 2 and of the VESC driver, for recordings without definitions."""
    typesys = library("typesys")
    store, types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), typesys.get_types_from_msg
    state = "vesc_msgs/msg/VescState"
    store.register(types(VESC_STATE_ROS2, state))
    store.register(types(f"std_msgs/Header header\n{state} state\n", VESC_TYPE))
    return store
