"""A segment of the ring: an MCAP file, written in sequence by chunks that each stand for themselves.

Any reader of MCAP opens a segment that was closed. Of one that a killed process left, or that is being
written, every closed chunk can be read.
"""

from __future__ import annotations

import json
import logging
import math
import os
from base64 import b64encode
from pathlib import Path
from typing import Any, Iterator, Mapping, NamedTuple

from iort_agent.errors import AgentError
from iort_agent.recorder.config import LZ4, NONE, ZSTD
from iort_contract.messages.recorder import CHANNEL_STREAM
from iort_contract.ros.message import RosType

_log = logging.getLogger(__name__)

LIBRARY = "iort-agent"
JSON = "json"
# The key of a channel's metadata that is the ring's own.
_RUN = "iort_run"
# A chunk is closed by the ring, after a time or some bytes; never by the library.
_NEVER = 2**62
_MOST_NS = 2**63 - 1
_KINDS = {bool: "boolean", int: "number", float: "number", str: "string"}
_BASE64 = {"type": "string", "contentEncoding": "base64"}


class RingChannel(NamedTuple):
    """What the messages of a topic are: ``topic`` is the ROS topic, or else the stream. ``encoding`` is
    ``ros1``, ``cdr`` or ``json``; ``schema``, ``schema_encoding``, ``definition`` and ``metadata`` are as
    MCAP has them. ``run`` is the agent's run that heard them."""

    stream: str
    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes
    metadata: Mapping[str, str]
    run: str


class RingMessage(NamedTuple):
    """A message in the ring. ``seq`` counts the channel's messages of the run, dropped ones too: a gap is a
    loss. ``ring_us`` is its arrival in the ring's time, ``t_us`` the sample's own time."""

    channel: RingChannel
    seq: int
    ring_us: int
    t_us: int
    data: bytes


class Segment(NamedTuple):
    """A file of the ring; ``closed`` ones do not change any more. Its last message is about ``to_us``."""

    path: Path
    from_us: int
    to_us: int
    size: int
    closed: bool


def require_mcap() -> None:
    """Raise `AgentError` without the package."""
    try:
        from mcap.writer import Writer  # noqa: PLC0415 - optional

        Writer.flush  # noqa: B018 - an older one closes no chunk in time
    except (ImportError, AttributeError) as error:
        raise AgentError(f"recorder: {error}: pip install 'iort-agent[recorder]'") from error


def ros_channel(stream: str, kind: RosType, run: str) -> RingChannel:
    """The channel of a ROS topic's messages."""
    metadata = {CHANNEL_STREAM: stream, _RUN: run}
    if kind.ros2:
        metadata.update(topic_type_hash=kind.md5sum, offered_qos_profiles="")
    else:
        metadata.update(md5sum=kind.md5sum, topic=kind.topic)
    encodings = ("cdr", "ros2msg") if kind.ros2 else ("ros1", "ros1msg")
    definition = kind.definition.encode("utf-8", "replace")
    return RingChannel(stream, kind.topic, encodings[0], kind.name, encodings[1], definition, metadata, run)


def json_channel(stream: str, values: Mapping[str, Any], run: str) -> RingChannel:
    """The channel of a stream whose samples have such fields."""
    schema = {
        "type": "object",
        "title": stream,
        "properties": {name: _schema_of(value) for name, value in values.items()},
    }
    metadata = {CHANNEL_STREAM: stream, _RUN: run}
    definition = json.dumps(schema).encode()
    return RingChannel(stream, stream, JSON, f"iort.{stream}", "jsonschema", definition, metadata, run)


def _schema_of(value: Any) -> Mapping[str, Any]:
    if isinstance(value, bytes):
        return _BASE64
    kind = _KINDS.get(type(value))
    return {"type": [kind, "null"]} if kind else {}


def json_message(values: Mapping[str, Any]) -> bytes:
    """A sample as JSON; bytes are base64, and what is not finite is null."""
    try:
        text = json.dumps(values, default=_plain, allow_nan=False, separators=(",", ":"))
    except ValueError:
        finite = {name: None if _is_odd(value) else value for name, value in values.items()}
        text = json.dumps(finite, default=_plain, separators=(",", ":"))
    return text.encode()


def _is_odd(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _plain(value: Any) -> str:
    return b64encode(value).decode() if isinstance(value, bytes) else str(value)


class SegmentFile:
    """A segment that is being written. Raises `OSError` for a disk that is full or fails; then only `abandon`
    may be called."""

    def __init__(self, path: Path, from_us: int, *, compression: str) -> None:
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415 - optional

        kinds = {LZ4: CompressionType.LZ4, ZSTD: CompressionType.ZSTD, NONE: CompressionType.NONE}
        self.path, self.from_us, self.to_us = path, from_us, from_us
        self.file = _File(path)
        self._writer = Writer(self.file, chunk_size=_NEVER, compression=kinds[compression])
        # By the channel's identity: hashing a definition for each message would cost more than writing it.
        self._ids: dict[int, tuple[int, RingChannel]] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._synced = 0
        try:
            self._writer.start(profile="", library=LIBRARY)
        except OSError:
            self.abandon()
            # Nobody knows of it.
            path.unlink()
            raise

    @property
    def size(self) -> int:
        """The bytes of the closed chunks."""
        return self.file.at

    def add(self, channel: RingChannel, seq: int, ring_us: int, t_us: int, data: bytes) -> None:
        """Add a message to the open chunk, in memory."""
        known = self._ids.get(id(channel))
        number = known[0] if known is not None else self._register(channel)
        self.to_us = max(self.to_us, ring_us)
        published_ns = min(max(t_us, 0) * 1000, _MOST_NS)
        self._writer.add_message(number, max(ring_us, 0) * 1000, data, published_ns, seq & 0xFFFFFFFF)

    def close_chunk(self) -> None:
        """Write the open chunk: it survives the process now."""
        self._writer.flush()
        self.file.good = self.file.at

    def finish(self) -> None:
        """Write the indexes. The file stays open for `sync`."""
        self._writer.finish()
        self.file.good = self.file.at

    def sync(self) -> bool:
        """Make what is written survive a power cut; whether there was something new."""
        if self._synced == self.file.at:
            return False
        os.fdatasync(self.file.fd)
        self._synced = self.file.at
        return True

    def close(self) -> None:
        """Let go of the file."""
        self.file.close()

    def abandon(self) -> None:
        """Leave the closed chunks alone in the file, and let go of it."""
        self.file.cut()
        self.file.close()

    def _register(self, channel: RingChannel) -> int:
        named = (channel.schema, channel.schema_encoding, channel.definition)
        schema = self._schemas.get(named)
        if schema is None:
            schema = self._schemas[named] = self._writer.register_schema(*named)
        number: int = self._writer.register_channel(
            channel.topic, channel.encoding, schema, dict(channel.metadata)
        )
        self._ids[id(channel)] = number, channel
        return number


class _File:
    """A file that is appended to without a buffer, so that an error leaves nothing behind in memory. ``good``
    is the end of what is whole."""

    def __init__(self, path: Path) -> None:
        self.fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        self.at = self.good = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self.fd, rest)
            self.at += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self.at

    def flush(self) -> None:
        """Nothing waits."""

    def cut(self) -> None:
        try:
            os.ftruncate(self.fd, self.good)
        except OSError as error:
            _log.debug("the ring's segment keeps a torn end: %s", error)

    def close(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1


def last_us(path: Path) -> int | None:
    """The time of the newest message in a segment; None if it has none."""
    from mcap.records import Chunk  # noqa: PLC0415 - optional

    times = [chunk.message_end_time // 1000 for chunk in _records(path) if isinstance(chunk, Chunk)]
    return max(times, default=None)


def read_segment(
    path: Path, from_us: int, to_us: int, known: dict[object, RingChannel]
) -> Iterator[RingMessage]:
    """The messages of a window, in order of time within a chunk. What is torn or damaged is left out.
    ``known`` keeps the channels, so that they are the same objects in all segments."""
    from mcap.records import Channel, Chunk, Message, Schema  # noqa: PLC0415 - optional
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 - as above

    schemas: dict[int, Schema] = {}
    channels: dict[int, RingChannel] = {}
    for chunk in _records(path):
        if not isinstance(chunk, Chunk):
            continue
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:  # noqa: BLE001 - damaged bytes raise about anything
            _log.warning("%s: a chunk is damaged: %s", path.name, error)
            continue
        messages = []
        for record in records:
            if isinstance(record, Message):
                if from_us <= record.log_time // 1000 <= to_us and record.channel_id in channels:
                    messages.append(record)
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel) and record.schema_id in schemas:
                channels[record.id] = _known(_channel(record, schemas[record.schema_id]), known)
        messages.sort(key=lambda message: message.log_time)
        for message in messages:
            yield RingMessage(
                channels[message.channel_id],
                message.sequence,
                message.log_time // 1000,
                message.publish_time // 1000,
                message.data,
            )


def _channel(channel: Any, schema: Any) -> RingChannel:
    metadata = dict(channel.metadata)
    stream, run = metadata.get(CHANNEL_STREAM, channel.topic), metadata.get(_RUN, "")
    encodings = channel.message_encoding, schema.name, schema.encoding
    return RingChannel(stream, channel.topic, *encodings, schema.data, metadata, run)


def _known(channel: RingChannel, known: dict[object, RingChannel]) -> RingChannel:
    key = (*channel[:6], tuple(sorted(channel.metadata.items())))
    return known.setdefault(key, channel)


def _records(path: Path) -> Iterator[Any]:
    """The records of a file, chunks as they are, up to where it is torn or damaged."""
    from mcap.stream_reader import StreamReader  # noqa: PLC0415 - optional

    try:
        with path.open("rb") as file:
            yield from StreamReader(file, emit_chunks=True, record_size_limit=2**31).records
    except FileNotFoundError:
        return  # evicted meanwhile
    except Exception as error:  # noqa: BLE001 - damaged bytes raise about anything
        _log.debug("%s: ends early: %s: %s", path.name, type(error).__name__, error)
