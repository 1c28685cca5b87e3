"""Reads MCAP files by their index. A file may be anybody's and its index forged, so each chunk is checked
before it is unpacked: against the file's size, and against what may be in memory.

    index ---> chunk ---> messages in order of time
      |          |            |
      |          |            +-- of chunks of the same time: at most twice ``most_bytes``
      |          +-- its own head agrees with the index; unpacks to the size that both say
      +-- inside the file, none inside another, at most ``most_bytes`` unpacked
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Generator, Iterator
from heapq import heapify, heappop, heappush
from io import SEEK_END, BytesIO
from itertools import count
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import MAGIC_SIZE, StreamReader, read_magic
from mcap.summary import Summary

from iort_contract.recordings.files import inflated
from iort_station.errors import StationError

# A chunk is unpacked in memory: 30 KB may become gigabytes.
MOST_CHUNK_BYTES = 256 * 1024 * 1024
# What a message takes in memory beside its content, at least.
_MESSAGE_BYTES = 200
# Times are counted from the epoch; what others do with them needs a sign.
_MOST_NS = 2**63 - 1
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
# What the library raises for a file that is no MCAP, or was damaged; a size in it may exceed the memory.
_UNREADABLE = (OSError, McapError, EOFError, ValueError, struct.error, OverflowError, MemoryError)


class McapMessage(NamedTuple):
    """A message: its channel's id, when it was logged and published, and its content."""

    channel: int
    log_ns: int
    publish_ns: int
    data: bytes


class McapIndex:
    """A file's index: its channels and schemas by their ids, the times of its first message and after its
    last one, and what its largest chunk unpacks to. Raises `StationError` if the file cannot be read by it.

    ``most_bytes`` is what a chunk may unpack to.
    """

    def __init__(self, path: Path, *, most_bytes: int = MOST_CHUNK_BYTES) -> None:
        self._path, self._most = path, most_bytes
        try:
            with path.open("rb") as file:
                summary = _summary(file)
                self._size = file.seek(0, SEEK_END)
        except _UNREADABLE as error:
            raise StationError(f"{path} must be an MCAP file: {error}") from error
        about = None if summary is None else summary.statistics
        if summary is None or about is None or not about.message_count:
            what = "has no index" if about is None else "has no messages"
            raise StationError(f"{path} {what}: `mcap recover` of the program mcap mends a file that was cut")
        self.channels: dict[int, Channel] = summary.channels
        self.schemas: dict[int, Schema] = summary.schemas
        self._chunks: list[ChunkIndex] = sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset)
        self.start_ns, self.end_ns = about.message_start_time, about.message_end_time + 1
        if not self.start_ns < self.end_ns <= _MOST_NS:
            raise self._damaged(f"it says messages from {self.start_ns} ns to {self.end_ns} ns")
        self._check_chunks()
        self.chunk_bytes = max((one.uncompressed_size for one in self._chunks), default=1)

    def _check_chunks(self) -> None:
        end = 0
        for one in self._chunks:
            if one.chunk_start_offset < end:
                raise self._damaged("it has a chunk within another one")
            end = one.chunk_start_offset + one.chunk_length
            if end > self._size:
                raise self._damaged(f"it has a chunk until byte {end:,} of {self._size:,}")
            if one.uncompressed_size > self._most:
                size = f"{one.uncompressed_size // 2**20:,} MB, at most {self._most // 2**20} MB are read"
                raise StationError(
                    f"{self._path} has a chunk of {size}: `mcap filter` of the program mcap writes smaller "
                    "ones"
                )

    def _damaged(self, why: str) -> StationError:
        return StationError(
            f"the index of {self._path} is damaged: {why}; `mcap recover` of the program mcap makes another"
        )

    def messages(
        self, channels: Collection[int], start_ns: int = 0, end_ns: int = _MOST_NS
    ) -> Generator[McapMessage, None, None]:
        """The messages of some channels from a time (inclusive) to another (exclusive), in order of the time
        when they were logged. Raises `StationError`."""
        try:
            with self._path.open("rb") as file:
                yield from self._messages(file, channels, start_ns, end_ns)
        except _UNREADABLE as error:
            raise StationError(f"{self._path} cannot be read any further: {error}") from error

    def _messages(
        self, file: IO[bytes], channels: Collection[int], start_ns: int, end_ns: int
    ) -> Iterator[McapMessage]:
        numbers, held = count(len(self._chunks)), 0
        # A chunk lies before the messages of its time.
        queue: list[tuple[int, int, ChunkIndex | McapMessage]] = [
            (one.message_start_time, number, one)
            for number, one in enumerate(self._chunks)
            if one.message_start_time < end_ns
            and one.message_end_time >= start_ns
            # Without them, a chunk may have messages of every channel.
            and (not one.message_index_offsets or not one.message_index_offsets.keys().isdisjoint(channels))
        ]
        heapify(queue)

        def take(messages: Iterator[McapMessage]) -> None:
            nonlocal held
            for one in messages:
                if one.channel in channels and start_ns <= one.log_ns < end_ns:
                    heappush(queue, (one.log_ns, next(numbers), one))
                    held += len(one.data) + _MESSAGE_BYTES
                    if held > 2 * self._most:
                        raise McapError(
                            f"more than {2 * self._most // 2**20:,} MB are of one time: `mcap sort` of the "
                            "program mcap writes it in order"
                        )

        if not self._chunks:
            take(_unchunked(file))
        while queue:
            _, _, one = heappop(queue)
            if isinstance(one, ChunkIndex):
                take(_inside(_unpacked(_chunk(file, one))))
            else:
                held -= len(one.data) + _MESSAGE_BYTES
                yield one


def metadata(path: Path) -> Iterator[Metadata]:
    """A file's records of metadata, by its index; none without an index. Raises `StationError`."""
    try:
        with path.open("rb") as file:
            summary = _summary(file)
            for index in summary.metadata_indexes if summary is not None else ():
                file.seek(index.offset)
                record = next(_records(file, skip_magic=True))
                if isinstance(record, Metadata):
                    yield record
    except _UNREADABLE as error:
        raise StationError(f"{path} must be an MCAP file: {error}") from error


def _records(file: IO[bytes], *, skip_magic: bool) -> Iterator[object]:
    """The records from here on, without those inside of chunks."""
    yield from StreamReader(file, skip_magic=skip_magic, emit_chunks=True).records


def _summary(file: IO[bytes]) -> Summary | None:
    """What a file says of itself at its end; None if it says nothing. The library's own unpacks each chunk to
    which a forged footer points."""
    read_magic(ReadDataStream(file))
    file.seek(-(FOOTER_SIZE + MAGIC_SIZE), SEEK_END)
    footer = next(_records(file, skip_magic=True))
    if not isinstance(footer, Footer):
        raise McapError("it has no footer")
    if footer.summary_start == 0:
        return None
    file.seek(footer.summary_start)
    summary = Summary()
    for record in _records(file, skip_magic=True):
        if isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, MetadataIndex):
            summary.metadata_indexes.append(record)
    return summary


def _unchunked(file: IO[bytes]) -> Iterator[McapMessage]:
    """The messages of a file without chunks."""
    for record in _records(file, skip_magic=False):
        if isinstance(record, Chunk):
            raise McapError("its index has no chunk: `mcap recover` of the program mcap makes another")
        if isinstance(record, Message):
            yield McapMessage(record.channel_id, record.log_time, record.publish_time, record.data)


def _chunk(file: IO[bytes], index: ChunkIndex) -> Chunk:
    """The chunk of an index, which is in the file."""
    file.seek(index.chunk_start_offset)
    opcode, length = _RECORD.unpack(file.read(_RECORD.size))
    if opcode != Opcode.CHUNK or _RECORD.size + length != index.chunk_length:
        raise McapError(f"no chunk of {index.chunk_length:,} bytes is at byte {index.chunk_start_offset:,}")
    chunk = Chunk.read(ReadDataStream(BytesIO(file.read(length))))
    if chunk.uncompressed_size != index.uncompressed_size:
        raise McapError(
            f"a chunk says that it unpacks to {chunk.uncompressed_size:,} bytes, and the index says "
            f"{index.uncompressed_size:,}"
        )
    return chunk


def _unpacked(chunk: Chunk) -> bytes:
    """A chunk's records; raises `McapError` if they have another size than the chunk says."""
    parts, size = [], 0
    for part in _parts(chunk):
        size += len(part)
        if size > chunk.uncompressed_size:
            break
        parts.append(part)
    if size != chunk.uncompressed_size:
        more = "more" if size > chunk.uncompressed_size else "less"
        raise McapError(f"a chunk unpacks to {more} than the {chunk.uncompressed_size:,} bytes that it says")
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _parts(chunk: Chunk) -> Iterator[bytes]:
    if chunk.compression == "":
        yield chunk.data
        return
    if chunk.compression not in {"lz4", "zstd"}:
        raise McapError(f"the compression must be lz4 or zstd, got {chunk.compression[:20]!r}")
    try:
        yield from inflated(chunk.compression, iter([chunk.data]))
    except Exception as error:
        # Each library raises its own.
        raise McapError(f"{chunk.compression} cannot be unpacked: {error}") from error


def _inside(data: bytes) -> Iterator[McapMessage]:
    """The messages in a chunk's records."""
    at = 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        end = at + length
        if end > len(data):
            raise McapError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, at)
            yield McapMessage(channel, log_ns, publish_ns, data[at + _MESSAGE.size : end])
        at = end
