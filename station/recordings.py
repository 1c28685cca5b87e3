"""Recordings for other tools: MCAP, which Foxglove opens, and ROS 1 bags, which `rosbag play` plays."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter

from station.blocks import Block
from station.errors import StationError
from station.messages import Maker


class Recording(Protocol):
    """A file that messages are written into."""

    def add(self, maker: Maker, blocks: Iterator[Block]) -> int:
        """Write all samples as messages of one topic; how many there were."""


class _Bag:
    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer

    def add(self, maker: Maker, blocks: Iterator[Block]) -> int:
        kind, written = maker.kind, 0
        connection = self._writer.add_connection(
            kind.topic,
            kind.kind.replace("/", "/msg/"),
            msgdef=maker.definition,
            md5sum=maker.md5sum,
            callerid="/iort",
        )
        for block in blocks:
            for t_ns, message in maker.messages(block):
                self._writer.write(connection, t_ns, message)
                written += 1
        return written


class _Mcap:
    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer

    def add(self, maker: Maker, blocks: Iterator[Block]) -> int:
        kind, written = maker.kind, 0
        schema = self._writer.register_schema(kind.kind, "ros1msg", maker.definition.encode())
        channel = self._writer.register_channel(
            kind.topic, "ros1", schema, {"md5sum": maker.md5sum, "callerid": "/iort"}
        )
        for block in blocks:
            for t_ns, message in maker.messages(block):
                self._writer.add_message(channel, t_ns, message, t_ns, written)
                written += 1
        return written


@contextmanager
def bag(path: Path) -> Iterator[Recording]:
    """A new ROS 1 bag, there once it is whole; raises `StationError` where the file exists."""
    with _new(path) as part, BagWriter(part) as writer:
        yield _Bag(writer)


@contextmanager
def mcap(path: Path) -> Iterator[Recording]:
    """A new MCAP file, there once it is whole; raises `StationError` where the file exists."""
    with _new(path) as part, part.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1", library="iort")
        yield _Mcap(writer)
        writer.finish()


@contextmanager
def _new(path: Path) -> Iterator[Path]:
    """Where to write what becomes ``path``, so that what broke off is never taken for a recording."""
    if path.exists():
        raise StationError(f"{path} exists")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.rename(path)
    finally:
        part.unlink(missing_ok=True)


KINDS = {".bag": bag, ".mcap": mcap}
__all__: Sequence[str] = ("KINDS", "Recording", "bag", "mcap")
