"""The latched messages, such as `/tf_static` and `/map`: those in force at the begin of a window are part of
its incident, though they came long before, and are evicted from the ring.

A message is in force from its arrival until its publisher's next. Of ROS 2, where nobody tells how many
messages a publisher gives to late subscribers, the newest 16 are, up to 1 MB, and always the newest; and few
versions tell which publisher of a topic sent a message.

They are a folder beside the ring's segments: a small MCAP file for what came of a topic in a second. A file
is deleted once nothing of it was in force since the ring's begin, or for the bounds: those of the past first.
"""

from __future__ import annotations

import hashlib
import logging
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Iterable, Iterator, NamedTuple, Sequence, Tuple

from iort_agent.errors import AgentError
from iort_agent.recorder.ledger import fits
from iort_agent.recorder.segment import RingChannel, RingMessage, SegmentFile, read_segment

_log = logging.getLogger(__name__)

FOLDER = "latched"
# The part of the ring's bytes that they may take; also of one topic's files.
SHARE, _MOST_FILES = 0.125, 64
# Messages that wait for their file: of a topic, in bytes, and for how long.
_TOGETHER, _TOGETHER_BYTES, _TOGETHER_US = 16, 1_000_000, 1_000_000
# What waits in memory for a disk that is full or fails, of a topic; and what each takes beside its bytes.
_MEMORY_BYTES, _OVERHEAD = 16_000_000, 1000
# Keys of a channel's metadata: the publisher, and the size of a message that is gone. That one is kept
# without its bytes, because what was before it is not in force any more.
_PUBLISHER, _GONE = "iort_publisher", "iort_gone"
# A topic's publisher: stream, topic, schema, publisher.
_Key = Tuple[str, str, str, str]


class Latched(NamedTuple):
    """What is in force at a time, in order of arrival, each with its publisher; and all topics that latch."""

    messages: Sequence[tuple[str, RingMessage]]
    topics: frozenset[str]


@dataclass(frozen=True)
class _Known:
    """A message: of whom, when it came, its digest and size, and the number of its file."""

    key: _Key
    ros2: bool
    ring_us: int
    digest: bytes
    size: int
    file: int


class LatchedFolder:
    """The ring's thread calls it; any thread may call `in_force`."""

    def __init__(self, ring: Path, *, compression: str, max_bytes: int) -> None:
        """Raises `AgentError` if the folder cannot be made."""
        self._folder, self._compression, self._max_bytes = ring / FOLDER, compression, max_bytes
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise AgentError(f"recorder: {self._folder}: {error.strerror}") from error
        self._lock = Lock()
        # What waits for its file, by stream, topic and schema.
        self._waiting: dict[tuple[str, ...], list[tuple[str, RingMessage, bytes]]] = {}
        self._known: list[_Known] = []
        self._sizes: dict[int, int] = {}
        # Messages that are too large, or did not find room in memory or on the disk.
        self.dropped = 0
        self._failing = False
        for path in sorted(self._folder.glob("*.mcap")):
            self._find(path)
        self._next = 1 + max(self._sizes, default=-1)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return sum(self._sizes.values())

    @property
    def newest_us(self) -> int:
        """When the newest message came, by the ring's time; 0 without one."""
        return self._known[-1].ring_us if self._known else 0

    def put(self, message: RingMessage, publisher: str, *, again: bool, gone: bool = False) -> None:
        """Take a message; one that came ``again`` is in force since before it came, if it is not known. One
        that is too large, or ``gone``, ends the one before it."""
        digest = _digest(message.data)
        key = _key(message.channel, publisher)
        waiting = self._waiting.setdefault(key[:3], [])
        same = [one for one in self._known if one.key == key]
        # ROS 2 may tell another name of a publisher that a new run finds.
        length = 3 if again and message.channel.encoding == "cdr" else 4
        digests = [one.digest for one in self._known if one.key[:length] == key[:length]]
        digests += [one[2] for one in waiting if length == 3 or one[0] == publisher]
        if digests and (digest in digests if again else digest == digests[-1]):
            return
        if gone or len(message.data) > self._max_bytes // 2:
            self.dropped += 1
            channel = message.channel
            metadata = {**channel.metadata, _GONE: str(len(message.data))}
            message = message._replace(channel=channel._replace(metadata=metadata), data=b"")
        if again:
            message = message._replace(ring_us=max((one.ring_us + 1 for one in same), default=0))
        waiting.append((publisher, message, digest))
        mine = [one for one in waiting if one[0] == publisher]
        while len(mine) > 1 and _too_many([len(one[1].data) for one in mine]):
            waiting.remove(mine.pop(0))
        # Each of a node's restarts may be another publisher.
        while len(waiting) > 1 and sum(_OVERHEAD + len(one[1].data) for one in waiting) > _MEMORY_BYTES:
            waiting.pop(0)
            self.dropped += 1

    def tick(self, now_us: int, since_us: int, *, flush: bool = False) -> list[SegmentFile]:
        """Write what has waited, or all; the files to be synced. ``since_us`` is the ring's begin."""
        files: list[SegmentFile] = []
        for topic, waiting in [*self._waiting.items()]:
            if waiting and (flush or now_us - waiting[0][1].ring_us >= _TOGETHER_US):
                try:
                    files.append(self._write(waiting))
                except OSError as error:
                    # They stay in memory, and are tried again.
                    level, self._failing = logging.DEBUG if self._failing else logging.WARNING, True
                    _log.log(level, "latched messages: %s: %s", self._folder, error.strerror or error)
                    continue
                self._failing = False
                del self._waiting[topic]
        if files:
            self._bound(since_us)
        return files

    def in_force(self, at_us: int, wanted: Iterable[str] | None) -> Latched:
        """What is in force at a time of the ring, of topics that fit one of the patterns."""
        with self._lock:
            known = [*self._known]
        patterns = ["*"] if wanted is None else list(wanted)
        chosen = [one for one in _in_force(known, at_us) if fits(patterns, one.key[1], one.key[0])]
        found: list[tuple[str, RingMessage]] = []
        channels: dict[object, RingChannel] = {}
        for file in sorted({one.file for one in chosen}):
            here = {(one.key, one.ring_us, one.digest) for one in chosen if one.file == file}
            for publisher, message, digest in _read(self._path(file), channels):
                named = (_key(message.channel, publisher), message.ring_us, digest) in here
                if named and _GONE not in message.channel.metadata:
                    found.append((publisher, message))
        found.sort(key=lambda one: one[1].ring_us)
        return Latched(found, frozenset(one.key[1] for one in known))

    def give_way(self, now_us: int) -> None:
        """Make room on a full disk: what is not in force any more goes first. The rest waits in memory for
        the disk, as far as it is small."""
        before = self.size
        self._bound(now_us)
        if self.size < before or not before:
            return
        left = _MEMORY_BYTES
        older: dict[tuple[str, ...], list[tuple[str, RingMessage, bytes]]] = {}
        for publisher, message in self.in_force(2**62, None).messages:
            left -= len(message.data)
            if left >= 0:
                kept = publisher, message, _digest(message.data)
                older.setdefault(_key(message.channel, publisher)[:3], []).append(kept)
            else:
                self.dropped += 1
        for file in [*self._sizes]:
            self._delete(file)
        for key, messages in older.items():
            self._waiting[key] = messages + self._waiting.get(key, [])

    def _write(self, waiting: Sequence[tuple[str, RingMessage, bytes]]) -> SegmentFile:
        number = self._next
        self._next += 1
        file = SegmentFile(self._path(number), waiting[0][1].ring_us, compression=self._compression)
        try:
            named: dict[tuple[str, str], RingChannel] = {}
            for publisher, message, _ in waiting:
                channel = message.channel
                # A file has one topic's messages of one type.
                key = publisher, channel.metadata.get(_GONE, "")
                if key not in named:
                    named[key] = channel._replace(metadata={**channel.metadata, _PUBLISHER: publisher})
                file.add(named[key], message.seq, message.ring_us, message.t_us, message.data)
            file.finish()
        except OSError:
            file.abandon()
            file.path.unlink()
            raise
        self._note(number, file.size, waiting)
        return file

    def _note(self, file: int, size: int, messages: Iterable[tuple[str, RingMessage, bytes]]) -> None:
        known = [
            _Known(
                _key(one.channel, publisher),
                one.channel.encoding == "cdr",
                one.ring_us,
                digest,
                int(one.channel.metadata.get(_GONE, len(one.data))),
                file,
            )
            for publisher, one, digest in messages
        ]
        with self._lock:
            self._known = sorted([*self._known, *known], key=lambda one: (one.ring_us, one.file))
            self._sizes[file] = size

    def _find(self, path: Path) -> None:
        """Take a file of an earlier run."""
        messages = [*_read(path, {})]
        if path.stem.isdigit() and messages:
            self._note(int(path.stem), path.stat().st_size, messages)
        else:
            # Torn by a power cut.
            with suppress(OSError):
                path.unlink()

    def _bound(self, since_us: int) -> None:
        """Delete what was not in force since ``since_us``, and for the bounds what is of the past."""
        needed = {one.file for one in _in_force(self._known, since_us)}
        needed |= {one.file for one in self._known if one.ring_us > since_us}
        for file in self._sizes.keys() - needed:
            self._delete(file)
        now = {one.file for one in _in_force(self._known, 2**62)}
        for topic in {one.key[:3] for one in self._known}:
            files = sorted({one.file for one in self._known if one.key[:3] == topic})
            past = [file for file in files if file not in now] + [file for file in files if file in now]
            for file in past[: max(0, len(files) - _MOST_FILES)]:
                self._delete(file)
        while self.size > self._max_bytes:
            past = sorted(self._sizes.keys() - now) or sorted(self._sizes)
            self._delete(past[0])

    def _delete(self, file: int) -> None:
        with suppress(OSError):
            self._path(file).unlink()
        with self._lock:
            self._known = [one for one in self._known if one.file != file]
            self._sizes.pop(file, None)

    def _path(self, file: int) -> Path:
        return self._folder / f"{file:08d}.mcap"


def _key(channel: RingChannel, publisher: str) -> _Key:
    return channel.stream, channel.topic, channel.schema, publisher


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=8).digest()


def _too_many(sizes: Sequence[int]) -> bool:
    return len(sizes) > _TOGETHER or sum(sizes) > _TOGETHER_BYTES


def _in_force(known: Iterable[_Known], at_us: int) -> list[_Known]:
    """What is in force at a time; ``known`` is in order of arrival."""
    groups: dict[_Key, list[_Known]] = {}
    for one in known:
        if one.ring_us <= at_us:
            groups.setdefault(one.key, []).append(one)
    chosen = []
    for group in groups.values():
        # Of the same content, the newest.
        newest = [*{one.digest: one for one in group}.values()] if group[0].ros2 else group[-1:]
        newest.sort(key=lambda one: one.ring_us)
        while len(newest) > 1 and _too_many([one.size for one in newest]):
            newest.pop(0)
        chosen += newest
    return chosen


def _read(path: Path, channels: dict[object, RingChannel]) -> Iterator[tuple[str, RingMessage, bytes]]:
    """A file's messages with their publishers and digests."""
    for message in read_segment(path, 0, 2**62, channels):
        metadata = dict(message.channel.metadata)
        publisher = metadata.pop(_PUBLISHER, "")
        digest = _digest(message.data)
        yield publisher, message._replace(channel=message.channel._replace(metadata=metadata)), digest
