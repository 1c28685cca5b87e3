"""Plays a recording: ROS 1 ``.bag``, ROS 2 folders of ``.db3`` or ``.mcap``, VESC Tool's ``.csv``.

Needs no ROS.
"""

from __future__ import annotations

import logging
import os
import re
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ContextManager, Iterator, Mapping, NamedTuple, Optional, Sequence

from iort_agent.clock import Clock, SystemClock
from iort_agent.errors import SourceError
from iort_agent.schema import choice, existing_path, flag, number, pairs, setting, text
from iort_agent.sources import FAIL, OK, REFUSE, UPLOAD, WARN, Emit, Finding, SourceConfig
from iort_agent.sources.recording.look import look_into
from iort_agent.sources.recording.player import NOW, ORIGINAL, Message, Open, Playback, play
from iort_agent.sources.recording.tool_csv import VescLog
from iort_agent.sources.recording.unreadable import Wrapped, check_kind
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.messages.message_type import MessageType
from iort_contract.ros1.decode import Decoder, stamp_ns
from iort_contract.ros1.definition import parse
from iort_contract.ros1.message import RosMessage, RosType
from iort_contract.topics import check_stream

_log = logging.getLogger(__name__)

VESC_TYPE = "vesc_msgs/msg/VescStateStamped"
# `iort-agent check` looks into a recording for this long.
_LOOK_S = 10.0
# A header's stamp this far from when the message was recorded is a clock not yet set, or a simulation's.
_BELIEVABLE_NS = 3600 * 1_000_000_000


@dataclass(frozen=True)
class BagConfig(SourceConfig):
    """A recording to play.

    ``topics`` maps ROS topics to streams; without it, every VescStateStamped becomes ``stream``, as does
    a log of VESC Tool, which has no topics. ``speed`` is a factor, 0 for as fast as possible. ``stamps``:
    ``now`` moves the recording to when it is played, ``original`` keeps its own times. ``duration_s`` is
    counted in the recording's time. ``large: upload`` sends bytes (images, point clouds) as files.
    """

    path: Path = setting(existing_path(folder=True))
    topics: tuple[tuple[str, str], ...] | None = setting(
        pairs(text(check_stream), what="a mapping of ROS topic to stream name"), default=None
    )
    speed: float = setting(number(0, 1000), 1.0)
    stamps: str = setting(choice(NOW, ORIGINAL), NOW)
    loop: bool = setting(flag(), default=False)
    duration_s: float | None = setting(number(0.001, 1e9, unit="s"), None)
    stream: str = setting(text(check_stream), VESC_STREAM)
    large: str = setting(choice(REFUSE, UPLOAD), REFUSE)

    def streams(self) -> Sequence[str]:
        """The streams named; several topics may share one."""
        return sorted({stream for _, stream in self.topics}) if self.topics else [self.stream]

    def describe(self) -> str:
        """The source in a few words."""
        return f"bag {self.path}"

    def build(self, clock: Clock) -> BagSource:
        """Make the source; the file is opened when it runs."""
        return BagSource(self, clock)

    def uploads_large(self) -> bool:
        """Whether bytes are sent as files."""
        return self.large == UPLOAD

    def check(self, title: str) -> Iterator[Finding]:
        """Whether the recording can be read, and has a message of every stream."""
        if not self.path.exists():
            yield Finding(title, FAIL, f"{self.path} is not there")
            return
        if not os.access(self.path, os.R_OK):
            yield Finding(title, FAIL, f"{self.path} may not be read", f"chmod a+r {self.path}")
            return
        wanted = set(self.streams())
        looked = look_into(self.build(SystemClock()).open, wanted, _LOOK_S)
        if looked.error:
            yield Finding(title, FAIL, looked.error)
            return
        if looked.streams:
            yield Finding(title, OK, f"has messages of {', '.join(looked.streams)}")
        missing = ", ".join(sorted(wanted.difference(looked.streams)))
        if missing and looked.ended:
            yield Finding(title, FAIL, f"it has no message of {missing}", "see `topics`")
        elif missing:
            yield Finding(title, WARN, f"no message of {missing} was found within {_LOOK_S:g} s")


class BagSource:
    """Emits the messages of a recording at the recording's own pace."""

    def __init__(self, config: BagConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        is_log = config.path.suffix.lower() == ".csv"
        self._log = VescLog(config.path, config.stream, config.stamps) if is_log else None

    def report(self) -> Mapping[str, Any]:
        """Of a log of VESC Tool what became of its rows; of a bag nothing that the streams' own counts do
        not say."""
        return {} if self._log is None else self._log.report()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Play until the end, or for ever with ``loop``. Raises `SourceError`."""
        config = self._config
        how = Playback(config.speed, config.stamps, config.loop, config.duration_s)
        play(self._recording(), how, self._clock, emit, stop)

    def open(self) -> ContextManager[Iterator[Message]]:
        """The recording's messages, in the order recorded, for a ``with`` block. Raises `SourceError`."""
        return self._recording()()

    def _recording(self) -> Open:
        config = self._config
        if self._log is None:
            large = config.large == UPLOAD
            return lambda: Recording(config.path, config.topics, config.stream, large=large)
        if config.topics is not None:
            raise SourceError(f"{config.path}: a log of VESC Tool has no topics; `stream` names its stream")
        return self._log.open


class Recording:
    """A bag, open for reading. What the library raises comes out as `SourceError`."""

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
        with self._wrapped("cannot be opened"):
            self._reader = AnyReader([path.parent if in_folder else path], default_typestore=_known_types())

    def __enter__(self) -> Iterator[Message]:
        with self._wrapped("cannot be read"):
            self._reader.open()
        store = self._reader.typestore
        # Renamed between the versions for Python 3.8 and later.
        self._known: dict[str, Any] = store.fielddefs if hasattr(store, "fielddefs") else store.FIELDDEFS
        try:
            return self._messages(self._streams())
        except SourceError:
            self._reader.close()
            raise

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def _streams(self) -> dict[str, str]:
        """ROS topic -> stream, of those asked for. Raises `SourceError` that lists what there is."""
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
            if there[topic] not in self._known:
                raise SourceError(
                    f"{self._path}: the topic {topic} is of type {there[topic]}, whose definition is neither "
                    "in the recording nor known to the agent; `ros2 bag convert` into MCAP adds it"
                )
        return wanted

    def _messages(self, streams: Mapping[str, str]) -> Iterator[Message]:
        """The messages of these topics in the order in which they were recorded."""
        connections = [c for c in self._reader.connections if c.topic in streams]
        start_ns = int(self._reader.start_time)
        iterator = iter(self._reader.messages(connections=connections))
        kinds: dict[tuple[str, str, str], _Kind] = {}
        while True:
            with self._wrapped("is damaged"):
                found = next(iterator, None)
                if found is None:
                    return
                connection, recorded_ns, raw = found
                if not self._reader.is2:
                    raw = bytes(raw)
                else:
                    raw = bytes(self._reader.typestore.cdr_to_ros1(raw, connection.msgtype))
            stream, at_ns = streams[connection.topic], recorded_ns - start_ns
            # One name may have had two definitions, each with its own connection.
            named = (connection.topic, connection.msgtype, connection.digest)
            kind = kinds.get(named)
            said = kind is not None
            if kind is None:
                kind = kinds[named] = self._kind(stream, connection)
            measured_ns = _stamp_ns(raw, recorded_ns) if kind.stamped else recorded_ns
            if not said and kind.sample is not None:
                yield Message(TYPES_STREAM, at_ns, measured_ns, kind.sample)
            contents: dict[str, Any] = {}
            if kind.large is not None:
                with suppress(MessageError):
                    values: dict[str, Any] = dict(kind.large.decode(raw))
                    contents = {name: v for name, v in values.items() if isinstance(v, bytes) and v}
            yield Message(stream, at_ns, measured_ns, RosMessage(raw, kind.whole, large=contents))

    def _kind(self, stream: str, connection: Any) -> _Kind:
        """What the messages of a topic are, as ROS 1 has it."""
        kind = connection.msgtype.replace("/msg/", "/")
        with self._wrapped(f"topic {connection.topic}: its type {kind} cannot be had"):
            store = self._reader.typestore
            definition, md5sum = store.generate_msgdef(connection.msgtype, ros_version=1)
            if self._reader.is2:
                definition, md5sum = _with_seq(definition, md5sum, connection.msgtype)
            else:
                # As it was recorded: with constants and comments.
                said = getattr(connection.msgdef, "data", connection.msgdef)
                definition, md5sum = (said, connection.digest) if said else (definition, md5sum)
        whole = RosType(connection.topic, kind, md5sum, definition)
        parsed = parse(kind, definition)
        sample = None
        try:
            sample = MessageType(stream, connection.topic, kind, md5sum, definition).sample()
        except ContractError as error:
            _log.warning("%s: topic %s: %s", self._path, connection.topic, error)
        return _Kind(whole, sample, parsed.stamped(), Decoder(parsed, large=True) if self._large else None)

    def _wrapped(self, what: str) -> Wrapped:
        return Wrapped(f"{self._path}: {what}")


class _Kind(NamedTuple):
    """The type of a topic's messages, and the sample that says so."""

    whole: RosType
    sample: Optional[Mapping[str, Value]]  # noqa: UP045 - evaluated, on Python 3.8 too
    stamped: bool
    large: Optional[Decoder]  # noqa: UP045 - as above


# A header of ROS 2 has no seq. The definition may end the text.
_ROS2_HEADER = re.compile(
    r"(=+\nMSG: std_msgs/Header\n)\s*(?:time|builtin_interfaces/Time) stamp\n\s*string frame_id(\n|\Z)"
)


def _with_seq(definition: str, md5sum: str, name: str) -> tuple[str, str]:
    """The definition and checksum with ROS 1's header, which the messages have once they are converted."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 - optional

    with_seq = _ROS2_HEADER.sub(r"\1uint32 seq\ntime stamp\nstring frame_id\2", definition)
    if with_seq == definition:
        return definition, md5sum
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(with_seq, name))
    return with_seq, store.generate_msgdef(name, ros_version=1)[1]


def _stamp_ns(raw: bytes, recorded_ns: int) -> int:
    """The header's stamp, or the time of recording if the stamp is missing or not believable."""
    t_ns = stamp_ns(raw)
    return t_ns if t_ns is not None and abs(t_ns - recorded_ns) < _BELIEVABLE_NS else recorded_ns


# Of vesc_msgs for ROS 2: recordings of Foxy and Humble hold no definitions. The order is the wire's.
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
    """The types of ROS 2 itself and the VESC driver's, for recordings without definitions."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415 - optional

    store = get_typestore(Stores.ROS2_HUMBLE)
    state = "vesc_msgs/msg/VescState"
    store.register(get_types_from_msg(_VESC_STATE_ROS2, state))
    store.register(get_types_from_msg(f"std_msgs/Header header\n{state} state\n", VESC_TYPE))
    return store
