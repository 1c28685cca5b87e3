"""A small picture of an incident, made from its file: the image nearest to the edge, or else a line of the
condition's field around it.

    footer, summary --> metadata: edge, condition --> index of the chunks near the edge --> one chunk

Only these parts are fetched. The file comes from a robot, which may be anybody's: what is fetched, unpacked
and decoded has a bound, and a file that cannot be read has no picture.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import IO, Any, NamedTuple, cast

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Message, MessageIndex, Schema

from iort_contract.catalog.derived import SOURCES
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.expression import ExpressionError
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.recorder import ABOUT_RECORD, CHANNEL_STREAM
from iort_contract.ros.decode import Decoder
from iort_contract.ros.definition import parse, short_kind
from iort_contract.triggers import parse_trigger
from iort_station.cloud import Cloud
from iort_station.data.images import COMPRESSED, IMAGE, ImageError, Images, Pixels
from iort_station.fleet.files import Ranged, StoredFile

# A picture's longest side.
SIDE = 160
# What is fetched of a file: its summary, and all.
_SUMMARY_BYTES, _MOST_BYTES = 4_000_000, 24_000_000
_MOST_UNPACKED, _MOST_INDEX = 40_000_000, 2_000_000
# All that is unpacked and decoded: an index may name one chunk, or one message, again and again.
_MOST_WORK = 200_000_000
# A line: so long around the edge, of so many points, from so many chunks.
_BEFORE_NS, _AFTER_NS = 15_000_000_000, 15_000_000_000
_MOST_POINTS, _MOST_CHUNKS = 200, 8
# The topics that are tried for an image, and for a field.
_MOST_TOPICS, _MOST_TOPICS_OF_A_FIELD = 3, 50
# What a wrong file makes the libraries raise.
_WRONG = (
    *(McapError, ContractError, MessageError, ImageError),
    *(ValueError, KeyError, IndexError, TypeError, OverflowError, RecursionError, MemoryError),
    *(struct.error, OSError, EOFError, SyntaxError, Warning),
)
_RECORD = struct.Struct("<BQ")


class Line(NamedTuple):
    """The values of a field, and when: in seconds after the edge."""

    field: str
    times_s: list[float]
    values: list[float]


class Picture(NamedTuple):
    """What is to be seen of an incident: a JPEG of an image of ``topic``, so long after the edge; a line; or
    nothing."""

    jpeg: bytes = b""
    topic: str = ""
    after_s: float = 0.0
    line: Line | None = None


def picture(cloud: Cloud, file: StoredFile) -> Picture:
    """The picture of an incident by its file. Raises what the bucket does."""
    content = Ranged(cloud, file, _SUMMARY_BYTES)
    with suppress(*_WRONG):
        reader = SeekingReader(cast("IO[bytes]", content), record_size_limit=_SUMMARY_BYTES)
        summary = reader.get_summary()
        if summary is None:
            return Picture()
        named = {one.name: one.metadata for one in reader.iter_metadata()}
        about = named.get(ABOUT_RECORD, {})
        content.most += _MOST_BYTES
        incident = _Incident(content, summary.chunk_indexes, _edge_ns(about))
        channels = [
            (channel, summary.schemas.get(channel.schema_id)) for channel in summary.channels.values()
        ]
        return _image(incident, channels) or _line(incident, channels, about) or Picture()
    return Picture()


def _edge_ns(about: Mapping[str, str]) -> int:
    """The time of the first edge by the ring's clock, which the messages' log times are of."""
    edge_us, from_us, begin_us, end_us = (
        int(about[name]) for name in ("edge_us", "from_us", "ring_from_us", "ring_to_us")
    )
    return min(max(begin_us + edge_us - from_us, begin_us), end_us) * 1000


class _Incident:
    """The messages of a file near its edge."""

    def __init__(self, file: Ranged, chunks: Sequence[ChunkIndex], edge_ns: int) -> None:
        self._file, self._chunks, self.edge_ns = file, chunks, edge_ns
        self._unpacked: tuple[int, bytes] | None = None
        self._work = _MOST_WORK

    def nearest(self, channel: Channel) -> Message | None:
        """The channel's message nearest to the edge."""
        best: tuple[int, ChunkIndex, int] | None = None
        for distance_ns, chunk in self._near(channel):
            # The distance of a chunk is the least of its messages.
            if best is not None and best[0] <= distance_ns:
                break
            for log_ns, at in self._index(chunk, channel):
                if best is None or abs(log_ns - self.edge_ns) < best[0]:
                    best = abs(log_ns - self.edge_ns), chunk, at
        return None if best is None else self._message(best[1], best[2])

    def around(self, channel: Channel) -> list[Message]:
        """Some of the channel's messages around the edge, in order."""
        entries: list[tuple[int, int, ChunkIndex]] = []
        for distance_ns, chunk in self._near(channel)[:_MOST_CHUNKS]:
            if distance_ns <= max(_BEFORE_NS, _AFTER_NS):
                entries += [
                    (log_ns, at, chunk)
                    for log_ns, at in self._index(chunk, channel)
                    if -_BEFORE_NS <= log_ns - self.edge_ns <= _AFTER_NS
                ]
        entries.sort(key=lambda entry: entry[:2])
        chosen = entries[:: -(-len(entries) // _MOST_POINTS) or 1]
        return [self._message(chunk, at) for _, at, chunk in chosen]

    def _near(self, channel: Channel) -> list[tuple[int, ChunkIndex]]:
        """The chunks with messages of a channel, and how far they are from the edge; the nearest first."""
        with_it = [chunk for chunk in self._chunks if channel.id in chunk.message_index_offsets]
        far = [
            max(0, chunk.message_start_time - self.edge_ns, self.edge_ns - chunk.message_end_time)
            for chunk in with_it
        ]
        return sorted(zip(far, with_it, strict=True), key=lambda pair: pair[0])

    def _index(self, chunk: ChunkIndex, channel: Channel) -> Sequence[tuple[int, int]]:
        self._file.seek(chunk.message_index_offsets[channel.id])
        _, length = _RECORD.unpack(self._file.read(_RECORD.size))
        if length > _MOST_INDEX:
            raise ValueError("the index of a chunk is too large")
        index = MessageIndex.read(ReadDataStream(io.BytesIO(self._file.read(length))))
        return cast("Sequence[tuple[int, int]]", index.records)

    def _message(self, chunk: ChunkIndex, at: int) -> Message:
        content = self._content(chunk)
        _, length = _RECORD.unpack_from(content, at)
        begin = at + _RECORD.size
        self._take(min(length, len(content)))
        return Message.read(ReadDataStream(io.BytesIO(content[begin : begin + length])), length)

    def _content(self, chunk: ChunkIndex) -> bytes:
        """The records of a chunk; the last one is kept."""
        if self._unpacked is None or self._unpacked[0] != chunk.chunk_start_offset:
            self._file.seek(chunk.chunk_start_offset + _RECORD.size)
            record = Chunk.read(ReadDataStream(cast("IO[bytes]", self._file)))
            content = _unpacked(record.compression, record.data)
            self._take(len(content))
            self._unpacked = chunk.chunk_start_offset, content
        return self._unpacked[1]

    def _take(self, size: int) -> None:
        self._work -= size
        if self._work < 0:
            raise ValueError("there is too much to decode")


def _unpacked(compression: str, data: bytes) -> bytes:
    """A chunk's content. The library would believe the file how large that is."""
    # They come with mcap.
    import lz4.frame  # type: ignore[import-untyped]  # noqa: PLC0415 - only files with it need it
    import zstandard  # noqa: PLC0415 - as above

    try:
        if compression == "lz4":
            content = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=_MOST_UNPACKED + 1))
        elif compression == "zstd":
            with zstandard.ZstdDecompressor(max_window_size=2**25).stream_reader(data) as unpacking:
                content = unpacking.read(_MOST_UNPACKED + 1)
        elif compression:
            raise ValueError(f"the compression {compression[:20]} is not known")
        else:
            content = data
    except (RuntimeError, zstandard.ZstdError) as error:
        raise ValueError(f"a chunk cannot be unpacked: {error}") from error
    if len(content) > _MOST_UNPACKED:
        raise ValueError("a chunk is too large")
    return content


# --- images ------------------------------------------------------------------------------------------


def _image(incident: _Incident, channels: Sequence[tuple[Channel, Schema | None]]) -> Picture | None:
    """The image nearest to the edge; a compressed one before a raw one, which is larger."""
    topics = sorted(
        (short_kind(schema.name) == IMAGE, channel.topic, channel.id, channel, schema)
        for channel, schema in channels
        if schema is not None and short_kind(schema.name) in {IMAGE, COMPRESSED}
    )
    for _, topic, _, channel, schema in topics[:_MOST_TOPICS]:
        with suppress(*_WRONG):
            message = incident.nearest(channel)
            if message is not None:
                images = Images(schema.name, schema.data.decode("utf-8", "replace"))
                pixels = images.pixels(message.data, 4 * SIDE)
                if pixels is not None:
                    return Picture(_small(pixels), topic, (message.log_time - incident.edge_ns) / 1e9)
    return None


def _small(pixels: Pixels) -> bytes:
    from PIL import Image  # noqa: PLC0415 - only pictures need it

    image = Image.fromarray(pixels)
    image.thumbnail((SIDE, SIDE))
    out = io.BytesIO()
    image.save(out, "JPEG", quality=80)
    return out.getvalue()


# --- lines -------------------------------------------------------------------------------------------


def _line(
    incident: _Incident, channels: Sequence[tuple[Channel, Schema | None]], about: Mapping[str, str]
) -> Picture | None:
    """The first field of the condition that the file has numbers of; else the speed of the VESC."""
    for stream, field in [*_fields(about), (VESC_STREAM, "speed")]:
        of_stream = [pair for pair in channels if not stream or _stream(pair[0]) == stream]
        for channel, schema in of_stream[:_MOST_TOPICS_OF_A_FIELD]:
            with suppress(*_WRONG):
                decode = _reader(channel, schema, field)
                points = [
                    ((message.log_time - incident.edge_ns) / 1e9, float(value))
                    for message in incident.around(channel)
                    if isinstance(value := decode(message.data).get(field), (int, float))
                    and np.isfinite(value)
                ]
                if len(points) > 1:
                    times_s, values = zip(*points, strict=True)
                    return Picture(line=Line(field, list(times_s), list(values)))
    return None


def _stream(channel: Channel) -> str:
    return str(channel.metadata.get(CHANNEL_STREAM, channel.topic))


def _fields(about: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The streams and fields of the first edge's condition, in its order; the stream is empty if it is not
    known."""
    edges = json.loads(about.get("edges", "[]"))
    when = str(edges[0].get("when", "")) if edges else ""
    try:
        rule = parse_trigger(when)
    except ExpressionError:
        return
    for name in sorted(rule.fields, key=when.find):
        stream, _, field = name.partition(".")
        yield stream, field
        for source in SOURCES.get(name, (name,)):
            yield VESC_STREAM, source
            yield "", source


def _reader(channel: Channel, schema: Schema | None, field: str) -> Callable[[bytes], Mapping[str, Any]]:
    """Decodes a field of a channel; raises one of `_WRONG` if the channel cannot have it."""
    if schema is None:
        raise ValueError("a message without a definition")
    if channel.message_encoding == "json":
        if field not in json.loads(schema.data)["properties"]:
            raise KeyError(field)
        return lambda data: cast("Mapping[str, Any]", json.loads(data))
    decoder = _decoder(schema, select=[field])
    if decoder.unknown:
        raise KeyError(field)
    return decoder.decode


def _decoder(schema: Schema, **how: Any) -> Decoder:
    return Decoder(parse(schema.name, schema.data.decode("utf-8", "replace")), **how)
