"""Writes recordings for other tools: MCAP, which Foxglove opens, and ROS 1 bags, which `rosbag play`
plays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.limits import MessageError
from iort_contract.ros.definition import md5sum as md5sum_of
from iort_contract.ros.definition import parse
from iort_station.errors import StationError
from iort_station.output import whole

Write = Callable[[int, bytes], None]

# ROS 1 has its own of these: a header with a seq, and times that are no messages.
_OF_ROS2 = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_EMPTY = "std_msgs/msg/Empty"


class Recording(Protocol):
    """A file of messages. ``ros2`` is true if it can hold those of ROS 2, too."""

    ros2: bool

    def topic(self, topic: str, kind: str, definition: str, md5sum: str, *, ros2: bool = False) -> Write:
        """Begin a topic's messages of one ROS 1 type. The function that is returned writes a message, with
        its time in nanoseconds since the epoch; with ``ros2``, in ROS 2's form, if the file can hold it.
        Raises `StationError` for an invalid definition."""


class _Bag:
    ros2 = False

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._connections: dict[tuple[str, str, str], Any] = {}

    def topic(
        self,
        topic: str,
        kind: str,
        definition: str,
        md5sum: str,
        *,
        ros2: bool = False,  # noqa: ARG002 - a bag of ROS 1
    ) -> Write:
        named = (topic, kind, md5sum)
        if named not in self._connections:
            try:
                self._connections[named] = self._writer.add_connection(
                    topic,
                    kind.replace("/", "/msg/"),
                    msgdef=definition,
                    md5sum=md5sum or checksum(kind, definition),
                    # A bag tells two types of one topic apart by their publishers.
                    callerid="/iort" if not self._connections else f"/iort_{len(self._connections)}",
                )
            except Exception as error:  # a bag library may raise anything
                raise StationError(f"topic {topic} of type {kind} cannot be written: {error}") from error
        connection = self._connections[named]
        return lambda t_ns, message: self._writer.write(connection, t_ns, message)


class _Mcap:
    ros2 = True

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._sequence = 0
        self._begun = False

    def begin(self, profile: str) -> None:
        """Write the head of the file, once. Some readers of ROS 2 insist on its profile."""
        if not self._begun:
            self._writer.start(profile=profile, library="iort")
            self._begun = True

    def topic(self, topic: str, kind: str, definition: str, md5sum: str, *, ros2: bool = False) -> Write:
        self.begin("ros2" if ros2 else "ros1")
        convert: Callable[[bytes], bytes] | None = None
        if ros2:
            text, convert = _to_ros2(kind, definition)
            schema = self._writer.register_schema(_ros2_name(kind), "ros2msg", text.encode())
            channel = self._writer.register_channel(topic, "cdr", schema)
        else:
            schema = self._writer.register_schema(kind, "ros1msg", definition.encode())
            about = {"md5sum": md5sum or checksum(kind, definition), "callerid": "/iort"}
            channel = self._writer.register_channel(topic, "ros1", schema, about)

        def write(t_ns: int, message: bytes) -> None:
            data = message if convert is None else bytes(convert(message))
            self._writer.add_message(channel, t_ns, data, t_ns, self._sequence)
            self._sequence += 1

        return write


def _ros2_name(kind: str) -> str:
    return kind.replace("/", "/msg/", 1)


def _to_ros2(kind: str, definition: str) -> tuple[str, Callable[[bytes], bytes]]:
    """ROS 2's definition of a type that was converted from it, and what converts its messages back."""
    name, known = _ros2_name(kind), get_typestore(Stores.ROS2_HUMBLE).fielddefs
    try:
        types = {**get_types_from_msg(definition, name), **{same: known[same] for same in _OF_ROS2}}
        for nested, (constants, fields) in types.items():
            # A message of ROS 2 is never empty.
            types[nested] = constants, fields or [known[_EMPTY][1][0]]
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        text, _ = store.generate_msgdef(name, ros_version=2)
    except Exception as error:  # a bag library may raise anything
        raise StationError(f"the type {kind} cannot be written as one of ROS 2: {error}") from error
    return text, partial(store.ros1_to_cdr, typename=name)


def checksum(kind: str, definition: str) -> str:
    """ROS 1's MD5 of a definition. Raises `StationError` if the definition is invalid."""
    try:
        return md5sum_of(parse(kind, definition), definition)
    except (MessageError, KeyError, ValueError) as error:
        raise StationError(f"the type {kind} cannot be read: {error}") from error


@contextmanager
def bag(path: Path, *, force: bool = False) -> Iterator[Recording]:
    """A new ROS 1 bag, which appears once it is whole. Raises `StationError` if the file exists."""
    with whole(path, force=force) as part, BagWriter(part) as writer:
        yield _Bag(writer)


@contextmanager
def mcap(path: Path, *, force: bool = False) -> Iterator[Recording]:
    """A new MCAP file, which appears once it is whole. Raises `StationError` if the file exists."""
    with whole(path, force=force) as part, part.open("wb") as file:
        writer = McapWriter(file)
        recording = _Mcap(writer)
        yield recording
        recording.begin("ros1")
        writer.finish()


KINDS = {".bag": bag, ".mcap": mcap}
