"""Writes recordings for other tools: MCAP, which Foxglove opens, and ROS 1 bags, which `rosbag play`
plays."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter

from iort_contract.limits import MessageError
from iort_contract.ros1.definition import md5sum as md5sum_of
from iort_contract.ros1.definition import parse
from iort_station.errors import StationError
from iort_station.output import whole

Write = Callable[[int, bytes], None]


class Recording(Protocol):
    """A file of messages."""

    def topic(self, topic: str, kind: str, definition: str, md5sum: str) -> Write:
        """Begin a topic's messages of one ROS 1 type. The function that is returned writes a message, with
        its time in nanoseconds since the epoch. Raises `StationError` for an invalid definition."""


class _Bag:
    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._connections: dict[tuple[str, str, str], Any] = {}

    def topic(self, topic: str, kind: str, definition: str, md5sum: str) -> Write:
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
    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._sequence = 0

    def topic(self, topic: str, kind: str, definition: str, md5sum: str) -> Write:
        schema = self._writer.register_schema(kind, "ros1msg", definition.encode())
        about = {"md5sum": md5sum or checksum(kind, definition), "callerid": "/iort"}
        channel = self._writer.register_channel(topic, "ros1", schema, about)

        def write(t_ns: int, message: bytes) -> None:
            self._writer.add_message(channel, t_ns, message, t_ns, self._sequence)
            self._sequence += 1

        return write


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
        writer.start(profile="ros1", library="iort")
        yield _Mcap(writer)
        writer.finish()


KINDS = {".bag": bag, ".mcap": mcap}
