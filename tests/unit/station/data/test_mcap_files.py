"""Files of MCAP that somebody has damaged or forged: each gets a line, and none unpacks more than it may."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import CompressionType, Writer

from iort_station.data.mcap_files import MOST_CHUNK_BYTES, McapIndex, McapMessage, metadata
from iort_station.errors import StationError

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL = Schema(1, b"{}", "jsonschema", "made"), Channel(1, "/made", "json", {}, 1)
PACK = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}


def raw(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


# Where a file's first part is.
FIRST = len(MAGIC + raw(Header("", "")))


def message(data: bytes, t_ns: int = 1) -> Message:
    return Message(1, t_ns, data, t_ns, 0)


def chunk(records: bytes, how: str = "zstd", *, start_ns: int = 1, end_ns: int = 1, **said: Any) -> Chunk:
    """A chunk of these records; ``said`` is what it says otherwise than it is."""
    facts = {"uncompressed_size": len(records), "compression": how, "data": PACK[how](records), **said}
    return Chunk(message_start_time=start_ns, message_end_time=end_ns, uncompressed_crc=0, **facts)


class File:
    """A file in parts, which can be forged."""

    def __init__(self, *parts: McapRecord) -> None:
        self.parts, self.end_ns = parts, 10
        head = MAGIC + raw(Header("", ""))
        self.body, at = head, []
        for part in parts:
            at.append(len(self.body))
            self.body += raw(part)
        self.indexes = [
            ChunkIndex(
                chunk_length=len(raw(one)),
                chunk_start_offset=place,
                compression=one.compression,
                compressed_size=len(one.data),
                message_end_time=one.message_end_time,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=one.message_start_time,
                uncompressed_size=one.uncompressed_size,
            )
            for place, one in zip(at, parts, strict=True)
            if isinstance(one, Chunk)
        ]
        self.others: Sequence[McapRecord] = ()
        self.summary_start: int | None = None

    def write(self, path: Path) -> Path:
        statistics = Statistics(0, 1, {1: 1}, len(self.indexes), 9, self.end_ns - 1, 1, 0, 1)
        body = self.body + raw(DataEnd(0))
        start = len(body) if self.summary_start is None else self.summary_start
        summary = raw(SCHEMA, CHANNEL, *self.indexes, *self.others, statistics, Footer(start, 0, 0))
        path.write_bytes(body + summary + MAGIC)
        return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ride.mcap"


def read(path: Path, **bound: int) -> Iterator[McapMessage]:
    return McapIndex(path, **bound).messages({1})


@pytest.mark.parametrize("how", list(PACK))
def test_messages_come_in_order_of_time_also_of_chunks_that_overlap(path: Path, how: str) -> None:
    late = raw(SCHEMA, CHANNEL, *(message(b"%d" % t_ns, t_ns) for t_ns in (2, 7, 3)))
    early = raw(*(message(b"%d" % t_ns, t_ns) for t_ns in (9, 1, 5)))
    File(chunk(late, how, start_ns=2, end_ns=7), chunk(early, how, start_ns=1, end_ns=9)).write(path)
    every = [(t_ns, b"%d" % t_ns) for t_ns in (1, 2, 3, 5, 7, 9)]
    assert [(one.log_ns, one.data) for one in read(path)] == every
    assert [one.log_ns for one in McapIndex(path).messages({1}, 3, 7)] == [3, 5]
    assert not list(McapIndex(path).messages({2}))


def test_a_file_without_chunks_is_read(path: Path) -> None:
    File(SCHEMA, CHANNEL, message(b"b", 2), message(b"a", 1)).write(path)
    assert [one.data for one in read(path)] == [b"a", b"b"]


@pytest.mark.parametrize("how", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_left(path: Path, how: str) -> None:
    """Its own head and the index agree on a size that is not true."""
    bomb = chunk(raw(message(bytes(2**20))), how, uncompressed_size=1000)
    File(bomb).write(path)
    with pytest.raises(StationError, match="a chunk unpacks to more than the 1,000 bytes that it says"):
        next(read(path))


def test_a_chunk_that_unpacks_to_less_than_it_says_is_left(path: Path) -> None:
    File(chunk(raw(message(b"x")), uncompressed_size=1000)).write(path)
    with pytest.raises(StationError, match="unpacks to less than the 1,000 bytes that it says"):
        next(read(path))


def test_a_chunk_that_would_fill_the_memory_is_refused(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=1)
        writer.start()
        schema = writer.register_schema("made", "jsonschema", b"{}")
        channel = writer.register_channel("/made", "json", schema)
        writer.add_message(channel, 1, bytes(MOST_CHUNK_BYTES), 1)
        writer.finish()
    assert path.stat().st_size < 100_000
    with pytest.raises(StationError, match="has a chunk of 256 MB, at most 256 MB are read: `mcap filter`"):
        McapIndex(path)


def test_an_index_that_says_less_than_its_chunk_is_refused(path: Path) -> None:
    forged = File(chunk(raw(message(bytes(5000)))))
    forged.indexes = [replace(forged.indexes[0], uncompressed_size=100)]
    with pytest.raises(StationError, match=r"unpacks to 5,0\d\d bytes, and the index says 100"):
        next(read(forged.write(path)))


def test_an_index_that_names_one_chunk_many_times_is_refused(path: Path) -> None:
    forged = File(chunk(raw(message(b"x"))))
    forged.indexes *= 1000
    with pytest.raises(StationError, match="it has a chunk within another one; `mcap recover`"):
        McapIndex(forged.write(path))


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"chunk_length": 2**40}, r"it has a chunk until byte 1,099,511,6\d\d,\d\d\d of \d{3}"),
        ({"chunk_start_offset": 2**63}, "it has a chunk until byte"),
        ({"chunk_start_offset": 8}, "no chunk of .* is at byte 8"),
        ({"chunk_length": 20}, "no chunk of 20 bytes is at byte"),
    ],
)
def test_an_index_that_names_no_chunk_is_refused(path: Path, said: dict[str, int], words: str) -> None:
    forged = File(chunk(raw(message(b"x"))))
    forged.indexes = [replace(forged.indexes[0], **said)]
    with pytest.raises(StationError, match=words):
        next(read(forged.write(path)))


@pytest.mark.parametrize("chunked", [True, False])
def test_more_of_one_time_than_the_memory_may_hold_is_refused(path: Path, chunked: bool) -> None:
    """Each chunk is small; so is the file."""
    some = [message(bytes(2**20))] * 3
    parts = [chunk(raw(one)) for one in some] if chunked else [SCHEMA, CHANNEL, *some]
    File(*parts).write(path)
    with pytest.raises(StationError, match="more than 2 MB are of one time: `mcap sort`"):
        next(read(path, most_bytes=2**20 + 100))
    assert len(list(read(path))) == 3


def test_messages_without_content_take_memory_too(path: Path) -> None:
    File(chunk(raw(message(b"")) * 12_000)).write(path)
    with pytest.raises(StationError, match="are of one time"):
        next(read(path, most_bytes=2**20))


def test_a_footer_that_points_at_a_chunk_unpacks_nothing(path: Path) -> None:
    """The library would unpack it, to look for the index in it."""
    hidden = raw(SCHEMA, CHANNEL, Statistics(0, 1, {1: 1}, 1, 9, 1, 1, 0, 1))
    forged = File(chunk(hidden))
    forged.summary_start = FIRST
    forged.indexes = []
    forged.write(path)
    found = McapIndex(path)
    assert found.end_ns == forged.end_ns, "from behind the chunk, and not from within"
    with pytest.raises(StationError, match="its index has no chunk: `mcap recover`"):
        next(found.messages({1}))


@pytest.mark.parametrize("end_ns", [1, 2**63 + 1, 2**64])
def test_times_that_no_clock_has_are_refused(path: Path, end_ns: int) -> None:
    forged = File(chunk(raw(message(b"x"))))
    forged.end_ns = end_ns
    with pytest.raises(StationError, match="it says messages from 1 ns to"):
        McapIndex(forged.write(path))


@pytest.mark.parametrize(
    ("records", "how", "words"),
    [
        (raw(message(b"x")), "snappy", "the compression must be lz4 or zstd, got 'snappy'"),
        (raw(message(b"x"))[:-1], "", "a record is longer than its chunk"),
        (b"\5", "", "cannot be read any further"),
        (b"\5\1" + bytes(8), "", "cannot be read any further"),
    ],
)
def test_a_chunk_of_something_else_is_told_in_a_line(
    path: Path, records: bytes, how: str, words: str
) -> None:
    File(chunk(records, "", compression=how)).write(path)
    with pytest.raises(StationError, match=words):
        next(read(path))


@pytest.mark.parametrize(("how", "begin"), [("zstd", b"\x28\xb5\x2f\xfd"), ("lz4", b"\x04\x22\x4d\x18")])
def test_a_damaged_chunk_is_told_in_a_line(path: Path, how: str, begin: bytes) -> None:
    File(chunk(raw(message(b"message " * 100)), how)).write(path)
    content = bytearray(path.read_bytes())
    at = content.find(begin)
    content[at + 8 : at + 30] = b"\xff" * 22
    path.write_bytes(content)
    with pytest.raises(StationError, match=f"cannot be read any further: {how} cannot be unpacked"):
        next(read(path))


@pytest.mark.parametrize(
    ("size", "summary_start", "words"),
    [
        (2**63, None, "cannot be read any further"),
        # The footer says that the index is where the chunk is.
        (2**62, FIRST, "must be an MCAP file"),
        (2**63, FIRST, "must be an MCAP file"),
    ],
)
def test_a_chunk_that_claims_exabytes_is_told_in_a_line(
    path: Path, size: int, summary_start: int | None, words: str
) -> None:
    made = chunk(raw(message(b"x")))
    forged = File(made)
    forged.summary_start = summary_start
    content, there = forged.write(path).read_bytes(), struct.pack("<Q", len(made.data)) + made.data
    assert content.count(there) == 1
    path.write_bytes(content.replace(there, struct.pack("<Q", size) + made.data))
    with pytest.raises(StationError, match=words):
        next(read(path))


def test_metadata_is_read_by_the_index_alone(path: Path) -> None:
    about = Metadata("incident", {"agent": "{}"})
    forged = File(about, chunk(raw(message(b"x"))))
    forged.others = [MetadataIndex(FIRST, len(raw(about)), "incident"), MetadataIndex(8, 1, "header")]
    assert [one.metadata for one in metadata(forged.write(path))] == [{"agent": "{}"}]
    forged.others = [MetadataIndex(2**63, 1, "nowhere")]
    with pytest.raises(StationError, match="must be an MCAP file"):
        list(metadata(forged.write(path)))
