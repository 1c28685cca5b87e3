"""The ring: the messages of the last minutes on disk, in MCAP segments that any reader of MCAP opens.

Times of the ring are microseconds that never jump: the wall clock when the agent began, or the end of the
ring that it found if that is later, and from there on the monotonic clock. They are an MCAP's log times; its
publish times are the samples' own. `Ring.ring_us` turns a wall time of now's clock into a time of the ring.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Container, Iterable, Iterator, Mapping, NamedTuple, Sequence

from iort_agent.common.threads import Clock
from iort_agent.recorder.config import RecorderConfig
from iort_agent.sources import Emit

# Why a message is not in the ring: the bounded memory was full, or the disk was.
MEMORY, DISK = "memory", "disk"


class RingChannel(NamedTuple):
    """What the messages of a stream are: ``topic`` is the ROS topic, or else the stream. ``encoding`` is
    ``ros1``, ``cdr`` or ``json``; ``schema`` and ``definition`` are as MCAP has them. ``run`` is the agent's
    run that heard them."""

    stream: str
    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes
    metadata: Mapping[str, str]
    run: str


class RingMessage(NamedTuple):
    """A message in the ring. ``seq`` counts the stream's messages of the run, dropped ones too: a gap is a
    loss. ``ring_us`` is its arrival in the ring's time, ``t_us`` the sample's own time."""

    channel: RingChannel
    seq: int
    ring_us: int
    t_us: int
    data: bytes


class Drop(NamedTuple):
    """Messages of a stream that were heard between two times of the ring, and are not in it."""

    stream: str
    from_us: int
    to_us: int
    messages: int
    why: str


class Segment(NamedTuple):
    """A file of the ring; ``closed`` ones do not change any more. Its last message is about ``to_us``."""

    path: Path
    from_us: int
    to_us: int
    size: int
    closed: bool


@dataclass
class Counts:
    """What became of a stream's messages in this run: ``written`` ones survive the process."""

    taken: int = 0
    written: int = 0
    bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


class Ring:
    """The ring of one run. Safe to use from several threads."""

    alarm: str | None = None

    def __init__(self, config: RecorderConfig, clock: Clock, *, folder: Path, run: str, reserve: int) -> None:
        """``run`` is the agent's boot; ``reserve`` are the bytes of the disk that belong to the queue. Raises
        `AgentError` without the package mcap, or if another process uses the folder."""
        raise NotImplementedError

    def around(self, emit: Emit, only: Container[str] = ()) -> Emit:
        """An `Emit` that keeps each sample first; those of the streams ``only`` go no further."""
        raise NotImplementedError

    def now_us(self) -> int:
        """The ring's time."""
        raise NotImplementedError

    def ring_us(self, wall_us: int) -> int:
        """The ring's time of a wall time, by the clock as it is set now."""
        raise NotImplementedError

    def since_us(self) -> int:
        """The earliest time that the ring still has: what was before is evicted."""
        raise NotImplementedError

    def start(self) -> None:
        """Begin to write in a thread of its own."""
        raise NotImplementedError

    def close(self) -> None:
        """Write everything and end the segment."""
        raise NotImplementedError

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything heard so far can be read; whether it can."""
        raise NotImplementedError

    def segments(self, from_us: int, to_us: int) -> Sequence[Segment]:
        """The files that may have messages of the window, oldest first."""
        raise NotImplementedError

    def read(self, from_us: int, to_us: int, wanted: Iterable[str] | None = None) -> Iterator[RingMessage]:
        """The messages of the window (ring's times, both ends included), about in order of time; also of the
        open segment, and of segments that a killed process left. ``wanted`` are patterns of topics and
        streams."""
        raise NotImplementedError

    def drops(self, from_us: int, to_us: int) -> Sequence[Drop]:
        """What was heard in the window and is not in the ring, as far as known; also of runs before."""
        raise NotImplementedError

    def counts(self) -> dict[str, Counts]:
        """The counts of each stream."""
        raise NotImplementedError
