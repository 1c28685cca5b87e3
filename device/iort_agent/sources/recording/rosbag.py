"""Reads the bags of ROS 1 and ROS 2 with the package rosbags, each message as ROS 1 has it."""

from __future__ import annotations

import logging
import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple, Optional, Sequence

from iort_agent.errors import SourceError
from iort_agent.sources.recording.player import Message
from iort_agent.sources.recording.unreadable import check_kind, wrapped
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.messages.message_type import MessageType
from iort_contract.ros1.decode import Decoder, Large, stamp_ns
from iort_contract.ros1.definition import md5sum, parse
from iort_contract.ros1.message import RosMessage, RosType

_log = logging.getLogger(__name__)

VESC_TYPE = "vesc_msgs/msg/VescStateStamped"
# A header stamp this far from the time of recording comes from a clock that is not set, or a simulation.
_BELIEVABLE_NS = 3600 * 1_000_000_000
# A ROS 2 header has no seq, and a converted message has one. The definition may end the text.
_ROS2_HEADER = re.compile(
    r"(=+\nMSG: std_msgs/Header\n)\s*(?:time|builtin_interfaces/Time) stamp\n\s*string frame_id(\n|\Z)"
)


class _Kind(NamedTuple):
    """The type of a topic's messages, and the sample that declares it."""

    whole: RosType
    sample: Optional[Mapping[str, Value]]  # noqa: UP045 - evaluated, on Python 3.8 too
    stamped: bool
    large: Optional[Decoder]  # noqa: UP045 - as above


class Recording:
    """A bag, open for reading. The library's errors come as `SourceError`."""

    def __init__(
        self, path: Path, topics: Sequence[tuple[str, str]] | None, stream: str, *, large: bool = False
    ) -> None:
        try:
            # Only a robot that plays recordings needs the library: pip install iort-agent[bag].
            from rosbags.highlevel import AnyReader  # noqa: PLC0415 - optional
        except ImportError as error:
            raise SourceError(
                "playing a bag needs the package rosbags: pip install 'iort-agent[bag]'"
            ) from error
        check_kind(path)
        # rosbags opens the folder of a ROS 2 recording; people name the file in it.
        in_folder = path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").exists()
        self._path = path
        self._topics = topics
        self._stream = stream
        self._large = large
        with wrapped(f"{path}: cannot be opened"):
            self._reader = AnyReader([path.parent if in_folder else path], default_typestore=_known_types())

    def __enter__(self) -> Iterator[Message]:
        with wrapped(f"{self._path}: cannot be read"):
            self._reader.open()
        try:
            return self._messages(self._streams())
        except SourceError:
            self._reader.close()
            raise

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def _streams(self) -> dict[str, str]:
        """Wanted ROS topic -> stream. Raises `SourceError`, which lists the recording's topics."""
        store = self._reader.typestore
        # Renamed between the versions for Python 3.8 and later.
        known = store.fielddefs if hasattr(store, "fielddefs") else store.FIELDDEFS
        there = {c.topic: c.msgtype for c in self._reader.connections}
        wanted = dict(self._topics or [(t, self._stream) for t, kind in there.items() if kind == VESC_TYPE])
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items())) or "no topic"
        missing = [topic for topic in wanted if topic not in there]
        if missing:
            raise SourceError(f"{self._path}: no topic {', '.join(missing)}; the recording has {listed}")
        if not wanted:
            raise SourceError(
                f"{self._path}: no topic of type {VESC_TYPE}, so `topics` must name some; "
                f"the recording has {listed}"
            )
        for topic in wanted:
            if there[topic] not in known:
                raise SourceError(
                    f"{self._path}: the topic {topic} is of type {there[topic]}, whose definition is neither "
                    "in the recording nor known to the agent; `ros2 bag convert` into MCAP adds it"
                )
        return wanted

    def _messages(self, streams: Mapping[str, str]) -> Iterator[Message]:
        """The messages of these topics, in the order of recording."""
        reader = self._reader
        start_ns = int(reader.start_time)
        iterator = iter(reader.messages(connections=[c for c in reader.connections if c.topic in streams]))
        kinds: dict[tuple[str, str, str], _Kind] = {}
        while True:
            with wrapped(f"{self._path}: is damaged"):
                found = next(iterator, None)
                if found is None:
                    return
                connection, recorded_ns, raw = found
                if reader.is2:
                    raw = reader.typestore.cdr_to_ros1(raw, connection.msgtype)
                raw = bytes(raw)
            stream, at_ns = streams[connection.topic], recorded_ns - start_ns
            # One name may have two definitions, each with its own connection.
            named = (connection.topic, connection.msgtype, connection.digest)
            known = named in kinds
            kind = kinds[named] = kinds[named] if known else self._kind(stream, connection)
            measured_ns = _measured_ns(raw, recorded_ns) if kind.stamped else recorded_ns
            if not known and kind.sample is not None:
                yield Message(TYPES_STREAM, at_ns, measured_ns, kind.sample)
            contents: dict[str, Any] = {}
            if kind.large is not None:
                with suppress(MessageError):
                    values: dict[str, Any] = dict(kind.large.decode(raw))
                    contents = {name: v for name, v in values.items() if isinstance(v, Large) and v}
            yield Message(stream, at_ns, measured_ns, RosMessage(raw, kind.whole, large=contents))

    def _kind(self, stream: str, connection: Any) -> _Kind:
        kind = connection.msgtype.replace("/msg/", "/")
        with wrapped(f"{self._path}: topic {connection.topic}: its type {kind} cannot be read"):
            text, md5 = self._reader.typestore.generate_msgdef(connection.msgtype, ros_version=1)
            # As recorded: with constants and comments. rosbags for Python 3.8 has the text itself.
            recorded = getattr(connection.msgdef, "data", connection.msgdef)
            if self._reader.is2:
                text = _ROS2_HEADER.sub(r"\1uint32 seq\ntime stamp\nstring frame_id\2", text)
                md5 = md5sum(parse(kind, text), text)
            elif recorded:
                text, md5 = recorded, connection.digest
            definition = parse(kind, text)
        sample = None
        try:
            sample = MessageType(stream, connection.topic, kind, md5, text).sample()
        except ContractError as error:
            _log.warning("%s: topic %s: %s", self._path, connection.topic, error)
        large = Decoder(definition, large=True) if self._large else None
        return _Kind(RosType(connection.topic, kind, md5, text), sample, definition.stamped(), large)


def _measured_ns(raw: bytes, recorded_ns: int) -> int:
    """The header stamp, or the time of recording if the stamp is missing or not believable."""
    t_ns = stamp_ns(raw)
    return t_ns if t_ns is not None and abs(t_ns - recorded_ns) < _BELIEVABLE_NS else recorded_ns


# vesc_msgs for ROS 2, since recordings of Foxy and Humble hold no definitions. The order is the wire's.
_VESC_STATE_ROS2 = """
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
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 - optional

    store = get_typestore(Stores.ROS2_HUMBLE)
    state = "vesc_msgs/msg/VescState"
    store.register(get_types_from_msg(_VESC_STATE_ROS2, state))
    store.register(get_types_from_msg(f"std_msgs/Header header\n{state} state\n", VESC_TYPE))
    return store
