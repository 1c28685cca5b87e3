"""What became of the ring's messages: which topics are kept, how many messages were heard, written and
dropped, and when."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any, Iterable, Sequence, Tuple

from iort_agent.recorder.folder import Drop
from iort_agent.recorder.segment import RingChannel
from iort_contract.ros.message import RosType
from iort_contract.topics import matches

# Why a message is not in the ring: the bounded memory was full, the disk was full or failed, or the ring's
# thread was at fault.
MEMORY, DISK, ERROR = "memory", "disk", "error"


@dataclass
class Counts:
    """What became of a stream's messages in this run: ``written`` ones survive the process."""

    taken: int = 0
    written: int = 0
    bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    def add(self, other: Counts) -> None:
        """Add the counts of another topic."""
        self.taken += other.taken
        self.written += other.written
        self.bytes += other.bytes
        for why, messages in other.dropped.items():
            self.dropped[why] = self.dropped.get(why, 0) + messages


class Topic:
    """One topic's messages of one type, or one stream's samples. ``kind`` is None for samples."""

    __slots__ = ("channel", "counts", "kind", "name", "seq", "stream", "wanted")

    def __init__(self, stream: str, kind: RosType | None, patterns: Iterable[str]) -> None:
        self.stream, self.kind = stream, kind
        self.name = kind.topic if kind is not None else stream
        self.wanted = fits(patterns, self.name, stream)
        self.seq = 0
        self.counts = Counts()
        # Made by the thread, of the first message.
        self.channel: RingChannel | None = None


# A message in the open chunk: topic, number, ring's time, own time, what to write.
Entry = Tuple[Topic, int, int, int, bytes]


def fits(patterns: Iterable[str], *names: str) -> bool:
    """Whether one of the names is one of the patterns' topics or streams."""
    return any(
        matches(pattern, name) if "*" in pattern else pattern == name
        for pattern in patterns
        for name in names
    )


class Ledger:
    """The topics of a run, and their counts. ``lock`` guards all of it."""

    def __init__(self, patterns: Sequence[str]) -> None:
        self._patterns = patterns
        self.lock = threading.Lock()
        self.topics: dict[Any, Topic] = {}
        self._drops: dict[tuple[Topic, str], list[int]] = {}

    def begin(self, key: object, stream: str, kind: RosType | None) -> Topic:
        """The topic of a first message."""
        with self.lock:
            return self.topics.setdefault(key, Topic(stream, kind, self._patterns))

    def drop(self, topic: Topic, why: str, ring_us: int) -> None:
        """Count a message as dropped; under the lock."""
        topic.counts.dropped[why] = topic.counts.dropped.get(why, 0) + 1
        drop = self._drops.setdefault((topic, why), [ring_us, ring_us, 0])
        drop[0], drop[1] = min(drop[0], ring_us), max(drop[1], ring_us)
        drop[2] += 1

    def drop_entries(self, entries: Iterable[Entry], why: str) -> None:
        """Count the messages of a chunk as dropped."""
        with self.lock:
            for topic, _, ring_us, _, _ in entries:
                self.drop(topic, why, ring_us)

    def wrote(self, entries: Iterable[Entry]) -> None:
        """Count the messages of a chunk as written."""
        with self.lock:
            for topic, _, _, _, payload in entries:
                topic.counts.written += 1
                topic.counts.bytes += len(payload)

    def drops(self, *, take: bool = False) -> Sequence[Drop]:
        """What was dropped since it was taken."""
        with self.lock:
            drops = [
                Drop(topic.stream, topic.name, from_us, to_us, messages, why)
                for (topic, why), (from_us, to_us, messages) in self._drops.items()
            ]
            if take:
                self._drops = {}
            return drops

    def counts(self) -> dict[str, Counts]:
        """The counts of each stream."""
        counts: dict[str, Counts] = {}
        with self.lock:
            for topic in self.topics.values():
                if topic.wanted:
                    counts.setdefault(topic.stream, Counts()).add(topic.counts)
        return counts
