"""Episodes for learning: all fields and images of a drive, a run or an incident at even steps of time.

A step has each field's last value before it, and each camera's last image. Where one of them is older than
`MAX_AGE_US`, nothing is known: there an episode ends, and the next one begins when all are known again.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Block, Column, column_of, join, ordered
from iort_contract.catalog.derived import SOURCES, Vehicle
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.recorder import CHANNEL_STREAM
from iort_contract.ros.definition import short_kind
from iort_contract.ros.message import MessageType, RosMessage, RosType
from iort_contract.topics import check_stream
from iort_station.cloud import Cloud
from iort_station.data import inventory, ros_messages
from iort_station.data.conditions import derive
from iort_station.data.export import Export
from iort_station.data.images import Images, Pixels
from iort_station.data.mcap_files import McapIndex
from iort_station.data.queries import samples
from iort_station.data.recorded import Selection
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet import files, registry

MAX_AGE_US = 1_000_000
MIN_S = 1.0
# A day of 100 steps a second: all steps of a source are in memory.
MOST_STEPS = 10_000_000
# The commands among a robot's topics, and their fields as samples have them.
_ACTIONS = {
    "ackermann_msgs/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/AckermannDriveStamped": ("speed", "steering_angle"),
    "geometry_msgs/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/TwistStamped": ("linear.x", "angular.z"),
}
# Of the driver of F1TENTH's VESC, whose topics have a number each.
_VESC_COMMANDS = (
    "/commands/motor/speed",
    "/commands/servo/position",
    # The last command as the driver has taken it.
    "/sensors/servo_position_command",
)
_STATE = ("current_motor", "current_input", "voltage_input", "duty_cycle")


class Field(NamedTuple):
    """A stream's field, written ``stream.field``."""

    stream: str
    name: str

    def __str__(self) -> str:
        return f"{self.stream}.{self.name}"


def field_of(text: str) -> Field:
    """Parse ``stream.field``; raises `UsageError`."""
    stream, _, name = text.partition(".")
    if not name:
        raise UsageError(f"a field must be STREAM.FIELD, such as vesc.speed_mps, got {text!r}")
    try:
        return Field(check_stream(stream), name)
    except ContractError as error:
        raise UsageError(str(error)) from error


@dataclass(frozen=True, kw_only=True)
class Shape:
    """What each step of an episode has, ``fps`` times a second: fields, and images of the streams
    ``cameras``."""

    fps: int
    state: tuple[Field, ...]
    action: tuple[Field, ...]
    cameras: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[Field, ...]:
        """The state's and the action's fields, each once."""
        return tuple(dict.fromkeys((*self.state, *self.action)))


class Source(Protocol):
    """What was recorded from ``start_us`` to ``end_us`` (exclusive); ``about`` is for the manifest."""

    @property
    def start_us(self) -> int: ...

    @property
    def end_us(self) -> int: ...

    @property
    def about(self) -> Mapping[str, Any]: ...

    def samples(self, stream: str, names: Sequence[str]) -> Block:
        """The samples with these fields, or the times alone without any; raises `StationError` for a field
        that no sample has."""

    def images(self, stream: str) -> Iterator[tuple[int, MessageType, bytes]]:
        """Times, types and messages of a camera."""


@dataclass(frozen=True)
class Stored:
    """A time of a robot, as table and archive have it."""

    cloud: Cloud
    robot: str
    start_us: int
    end_us: int
    about: Mapping[str, Any]

    def samples(self, stream: str, names: Sequence[str]) -> Block:
        return join(list(samples(self.cloud, self._selection(stream, tuple(names)))))

    def images(self, stream: str) -> Iterator[tuple[int, MessageType, bytes]]:
        types = ros_messages.types(self.cloud, self.robot)
        own = {name: kind for name, kind in types.items() if kind.stream == stream}
        export = Export(self.cloud, self._selection(stream), own, lambda key: files.content(self.cloud, key))
        for message in export.messages():
            yield message.t_us, export.types[message.type_id], message.raw

    def _selection(self, stream: str, fields: tuple[str, ...] | None = None) -> Selection:
        return Selection(
            robot=self.robot, stream=stream, start_us=self.start_us, end_us=self.end_us, fields=fields
        )


class Kept:
    """A recorder's incident, from its file, which may have what is not recorded otherwise.

    Raises `StationError` for a file that is no incident.
    """

    def __init__(self, path: Path, vehicle: Vehicle | None, about: Mapping[str, Any]) -> None:
        self.about = about
        self._path, self._vehicle = path, vehicle
        try:
            self._index = McapIndex(path)
        except StationError as error:
            raise StationError(f"{path.name} is no incident: {error}") from error
        self._topics = {
            channel.metadata.get(CHANNEL_STREAM, channel.topic): channel.topic
            for channel in self._index.channels.values()
        }
        self.start_us = self._index.start_ns // 1000
        self.end_us = (self._index.end_ns - 1) // 1000 + 1

    def samples(self, stream: str, names: Sequence[str]) -> Block:
        times: list[int] = []
        read: dict[str, list[Value]] = {name: [] for name in self._read(names)}
        for t_us, schema, channel, data in self._messages(stream):
            times.append(t_us)
            if read:
                sample = _sample(schema, channel, data)
                for name, column in read.items():
                    column.append(sample.get(name))
        columns = {name: column_of(column) for name, column in read.items() if set(column) - {None}}
        columns |= derive(columns, self._vehicle)
        if missing := [name for name in names if name not in columns]:
            raise StationError(f"{self._path.name} has no {', '.join(missing)} in {stream}")
        return ordered(Block(np.array(times, dtype=np.int64), {name: columns[name] for name in names}))

    def images(self, stream: str) -> Iterator[tuple[int, MessageType, bytes]]:
        for t_us, schema, channel, data in self._messages(stream):
            definition = schema.data.decode("utf-8", "replace")
            yield t_us, MessageType(stream, channel.topic, schema.name, "", definition), data

    def _read(self, names: Sequence[str]) -> set[str]:
        """The recorded fields that these need."""
        return {source for name in names for source in SOURCES.get(name, (name,))}

    def _messages(self, stream: str) -> Iterator[tuple[int, Any, Any, bytes]]:
        topic = self._topics.get(stream)
        if topic is None:
            raise unknown(
                f"{self._path.name} has no stream {stream}", [stream], self._topics, "mcap info FILE"
            )
        channels = {number: one for number, one in self._index.channels.items() if one.topic == topic}
        for message in self._index.messages(channels):
            channel = channels[message.channel]
            yield (
                message.publish_ns // 1000,
                self._index.schemas.get(channel.schema_id),
                channel,
                message.data,
            )


def _sample(schema: Any, channel: Any, data: bytes) -> Mapping[str, Value]:
    if channel.message_encoding == "json":
        sample: Mapping[str, Value] = json.loads(data)
        return sample
    return RosMessage(data, _ros_type(channel.topic, schema.name, schema.data))


@lru_cache(maxsize=256)
def _ros_type(topic: str, kind: str, definition: bytes) -> RosType:
    return RosType(topic, kind, "", definition.decode("utf-8", "replace"))


class Episode(NamedTuple):
    """Even steps in order of time, and a float32 column for each field; none has a null."""

    times_us: NDArray[np.int64]
    columns: Mapping[Field, NDArray[np.float32]]


def episodes(source: Source, shape: Shape) -> Iterator[Episode]:
    """The parts of a source in which all is known, each of at least a second.

    Raises `StationError` for a field that is not there, or is no number, and for more than `MOST_STEPS`.
    """
    step_us = 1_000_000 / shape.fps
    count = max(0, int((source.end_us - source.start_us) / step_us))
    if count > MOST_STEPS:
        raise StationError(
            f"an episode must have at most {MOST_STEPS:,} steps, got {count:,}: choose a lower --fps"
        )
    steps = np.arange(count)
    times = source.start_us + np.round(steps * step_us).astype(np.int64)
    known = np.ones(len(times), dtype=np.bool_)
    columns: dict[Field, Column] = {}
    for stream in dict.fromkeys(field.stream for field in shape.fields):
        own = [field for field in shape.fields if field.stream == stream]
        block = source.samples(stream, [field.name for field in own])
        for field in own:
            # What a float32 cannot hold is not known either.
            with np.errstate(over="ignore"):
                columns[field] = _held(times, block.times_us, _numbers(field, block)).astype(np.float32)
            known &= np.isfinite(columns[field])
    for camera in shape.cameras:
        seen = source.samples(camera, ()).times_us
        known &= ~np.isnan(_held(times, seen, np.zeros(len(seen))))
    edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(np.int8)))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if end - first >= MIN_S * shape.fps:
            part = slice(first, end)
            yield Episode(times[part], {name: of[part] for name, of in columns.items()})


def _numbers(field: Field, block: Block) -> Column:
    column = block.columns.get(field.name)
    if column is None:
        # Nothing of the stream is in this range.
        return np.full(len(block.times_us), np.nan)
    if column.dtype == object and any(isinstance(value, str) for value in column.tolist()):
        raise StationError(f"{field} must be a number, got a text")
    return column.astype(np.float64)


def _held(wanted: NDArray[np.int64], times: NDArray[np.int64], column: Column) -> Column:
    """The last value at or before each time; NaN for none, and for an older one than `MAX_AGE_US`."""
    there = ~np.isnan(column)
    times, column = times[there], column[there]
    last = np.searchsorted(times, wanted, side="right") - 1
    held = np.full(len(wanted), np.nan)
    fresh = last >= 0
    fresh[fresh] = wanted[fresh] - times[last[fresh]] <= MAX_AGE_US
    held[fresh] = column[last[fresh]]
    return held


class Frames:
    """A camera's image at each step, in order of time. ``not_kept`` counts images whose content the robot
    has not kept, ``damaged`` those that cannot be shown: the one before them stays."""

    def __init__(self, source: Source, camera: str) -> None:
        self._messages = source.images(camera)
        self._decoders: dict[tuple[str, str], Images] = {}
        self._next: tuple[int, MessageType, bytes] | None = next(self._messages, None)
        self._pixels: Pixels | None = None
        self.damaged = self.not_kept = 0

    def at(self, t_us: int) -> Pixels | None:
        """The last image at or before a time, which must not be before the last call's; None if there is
        no undamaged one."""
        newest = None
        while self._next is not None and self._next[0] <= t_us:
            newest, self._next = self._next, next(self._messages, None)
        if newest is not None:
            _, kind, raw = newest
            # A topic may change its type, and an incident's file tells only these two of it.
            type_ = kind.kind, kind.definition
            if type_ not in self._decoders:
                self._decoders[type_] = Images(*type_)
            try:
                pixels = self._decoders[type_].pixels(raw)
            except StationError:
                self.damaged += 1
            else:
                self.not_kept += pixels is None
                self._pixels = self._pixels if pixels is None else pixels
        return self._pixels


def from_images(episode: Episode, cameras: Collection[Frames], fps: int) -> Episode | None:
    """The episode from the first step with an image of every camera that can be shown; None if that is less
    than a second."""
    if not cameras:
        return episode
    for step, t_us in enumerate(episode.times_us.tolist()):
        if all([camera.at(t_us) is not None for camera in cameras]):  # noqa: C419 - each camera must go on
            if len(episode.times_us) - step < MIN_S * fps:
                break
            columns = {name: column[step:] for name, column in episode.columns.items()}
            return Episode(episode.times_us[step:], columns)
    return None


def usual_fields(cloud: Cloud, robot: str) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """The state and the action of a robot that has nothing else said: its motor controller's values, and its
    command topics. Either is empty if the robot has none."""
    streams = inventory.check_recorded(cloud, robot)
    state: list[Field] = []
    if VESC_STREAM in streams:
        columns = inventory.newest_block(cloud, robot, VESC_STREAM).columns
        there = {*columns, *derive(columns, registry.vehicle_of(cloud, robot))}
        speed = "speed_mps" if "speed_mps" in there else "speed"
        state = [Field(VESC_STREAM, name) for name in (speed, *_STATE) if name in there]
    action = [
        Field(kind.stream, name)
        for kind in ros_messages.types(cloud, robot).values()
        if kind.stream in streams
        for name in _action_of(kind)
    ]
    return tuple(dict.fromkeys(state)), tuple(dict.fromkeys(action))


def _action_of(kind: MessageType) -> Sequence[str]:
    if kind.topic in _VESC_COMMANDS:
        return ("data",)
    return _ACTIONS.get(short_kind(kind.kind), ())
