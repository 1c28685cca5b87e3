"""The ring: the messages of the last minutes on disk, in MCAP segments that any reader of MCAP opens.

```
  sources ── around ──► bounded memory ── thread ──► open chunk ──► segment ──► ... ──► evicted
                │              0.2 s           0.3 s or 1 MB   10 s or 8 MB
                ▼
          attachments, lanes
```

A killed process loses at most the last second, which was in memory, and a power cut what no closed chunk has:
each is synced, unless ``sync_s`` spares a medium the writes to its journal.

Times of the ring are microseconds that never jump: the wall clock when the agent began, or the end of the
ring that it found if that is later, and from there on the monotonic clock. They are an MCAP's log times; its
publish times are the samples' own. `Ring.ring_us` turns a wall time of now's clock into a time of the ring.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from pathlib import Path
from typing import Any, Container, Iterable, Iterator, Mapping, Optional, Sequence, Tuple

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock, Supervised
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.folder import EVERY, RESTART, SLACK_US, Drop, RingFolder
from iort_agent.recorder.latched import SHARE, Latched, LatchedFolder
from iort_agent.recorder.ledger import DISK, ERROR, MEMORY, Counts, Ledger, Topic, fits
from iort_agent.recorder.segment import RingChannel, RingMessage, Segment, read_segment, require_mcap
from iort_agent.recorder.writer import AGAIN, GONE, RingWriter
from iort_agent.sources import Emit
from iort_agent.sources.intake import Selected
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.message import RosMessage

__all__ = [
    "DISK",
    "ERROR",
    "EVERY",
    "MEMORY",
    "RESTART",
    "Counts",
    "Drop",
    "Ring",
    "RingChannel",
    "RingMessage",
    "Segment",
    "make_ring",
]

_log = logging.getLogger(__name__)

# How often the thread looks: a message is in a closed chunk after at most twice this and `CHUNK_S`.
LOOK_S = 0.2
# Bytes that wait and do not wait for the next look.
_HURRY_BYTES = 4 * 1024 * 1024
# Of a topic that is dropped, the list of drops has a line for each of these times.
_TELL_S = 1.0
# Messages that the thread takes at once.
_TOGETHER = 256
# What keeping a message in memory takes beside its bytes, and each of a sample's fields.
_OVERHEAD, _FIELD = 200, 100
# A message that came earlier than this before it was taken comes from a clock that was set.
_LATE_US = 1_000_000


# A message in memory: topic, number, ring's time, own time, what to write, who latches it, and the bytes that
# it takes.
_Item = Tuple[Topic, int, int, int, Any, Optional[str], int]


class Ring:
    """The ring of one run. Safe to use from several threads."""

    def __init__(self, config: RecorderConfig, clock: Clock, *, folder: Path, run: str, reserve: int) -> None:
        """``run`` is the agent's boot; ``reserve`` are the bytes of the disk that belong to the queue. Raises
        `AgentError` without the package mcap, or if another process uses the folder."""
        require_mcap()
        self._clock = clock
        self._folder = RingFolder(folder, config, reserve=reserve)
        self._throttled = ThrottledLog(_log, clock)
        self._latched = LatchedFolder(
            folder, compression=config.compression, max_bytes=round(config.max_mb * 1e6 * SHARE)
        )
        # They may be newer than the last segment.
        now_us = max(clock.now_us(), self._latched.newest_us + 1)
        found = self._folder.segments()
        if found:
            # The clock may have been set back meanwhile.
            now_us = max(now_us, found[-1].to_us + 1)
            self._folder.add_drops([Drop(EVERY, EVERY, found[-1].to_us, now_us, 0, RESTART)])
        self._base_us = now_us - round(clock.monotonic() * 1e6)
        self._began_us = now_us

        self._ledger = Ledger(config.topics)
        self._writer = RingWriter(
            self._folder, self._ledger, clock, run=run, sync_s=config.sync_s, latched=self._latched
        )

        # Under the ledger's lock.
        self._queue: deque[_Item] = deque()
        self._bytes = 0
        self._most_bytes = round(config.memory_mb * 1e6)
        self._hurry_bytes = min(_HURRY_BYTES, self._most_bytes // 2)
        self._flushes: list[threading.Event] = []
        self._told_at = clock.monotonic()

        self._kick, self._ending = threading.Event(), threading.Event()
        self._thread = Supervised("ring", self._work_until_end)

    @property
    def alarm(self) -> str | None:
        """What the operator should know and mend, in a line; None while all is well."""
        return self._writer.alarm

    # --- what sources call ---------------------------------------------------------------------------

    def around(self, emit: Emit, only: Container[str] = ()) -> Emit:
        """An `Emit` that keeps each sample first; those of the streams ``only`` go no further."""
        return _Kept(self, emit, only)

    def take(self, stream: str, t_us: int, values: Mapping[str, Any]) -> None:
        """Keep a sample, in memory first. Never blocks, never raises."""
        try:
            payload: Any = values
            kind = latched_by = None
            late_us = 0
            again = False
            message: Any = values
            if isinstance(values, Selected):
                again = values.again
                if values.whole is not None:
                    message = values.whole
            if isinstance(message, RosMessage):
                kind, payload, latched_by = message.kind, message.raw, message.latched_by
                size = len(payload) + _OVERHEAD
                if message.arrival_us:
                    late_us = self._clock.now_us() - message.arrival_us
            else:
                size = _OVERHEAD + sum(
                    _FIELD + len(value) if isinstance(value, (bytes, str)) else _FIELD
                    for value in values.values()
                )
            key = stream if kind is None else (stream, kind.id)
            topic = self._ledger.topics.get(key)
            if topic is None:
                topic = self._ledger.begin(key, stream, kind)
            if not topic.wanted:
                return
            ring_us = self.now_us()
            if 0 < late_us < _LATE_US:
                ring_us -= late_us
            with self._ledger.lock:
                full, seq = self._bytes + size > self._most_bytes, AGAIN
                if not again:
                    topic.counts.taken += 1
                    seq = topic.seq
                    topic.seq = seq + 1
                    if full:
                        self._ledger.drop(topic, MEMORY, ring_us)
                if full and (latched_by is None or again):
                    return
                if full:
                    seq, payload, size = GONE, b"", _OVERHEAD
                self._bytes += size
                self._queue.append((topic, seq, ring_us, t_us, payload, latched_by, size))
                hurry = self._bytes > self._hurry_bytes
            if hurry:
                self._kick.set()
        except Exception as error:  # noqa: BLE001 - whatever it is, the lanes must get the sample
            self._throttled.warn("take", f"ring: a message of {stream} is not kept: {error!r}")

    def missed_at(self) -> float:
        """Until when nobody misses a message that is for the ring alone."""
        return self._clock.monotonic() + LOOK_S

    # --- what the recorder calls ---------------------------------------------------------------------

    def now_us(self) -> int:
        """The ring's time."""
        return self._base_us + int(self._clock.monotonic() * 1e6)

    def ring_us(self, wall_us: int) -> int:
        """The ring's time of a wall time, by the clock as it is set now."""
        return wall_us + self.now_us() - self._clock.now_us()

    def since_us(self) -> int:
        """The earliest time that the ring still has: what was before is evicted, or was before the ring."""
        return self._folder.since_us(self._began_us)

    @property
    def evicted_why(self) -> str:
        """The bound for which a segment was deleted last; empty before the first."""
        return self._folder.evicted_why

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything heard so far can be read, or is dropped; whether it is."""
        done = threading.Event()
        with self._ledger.lock:
            self._flushes.append(done)
        self._kick.set()
        return self._clock.wait(done, timeout_s)

    def segments(self, from_us: int, to_us: int) -> Sequence[Segment]:
        """The files that may have messages of the window, oldest first."""
        file = self._writer.file
        segments = list(self._folder.segments())
        if file is not None and file.size and all(file.path != segment.path for segment in segments):
            segments.append(Segment(file.path, file.from_us, file.to_us, file.size, closed=False))
        return [
            segment
            for segment in segments
            if segment.from_us <= to_us + SLACK_US and segment.to_us >= from_us - SLACK_US
        ]

    def read(self, from_us: int, to_us: int, wanted: Iterable[str] | None = None) -> Iterator[RingMessage]:
        """The messages of the window (ring's times, both ends included), about in order of time; also of the
        open segment, and of segments that a killed process left. ``wanted`` are patterns of topics and
        streams."""
        patterns = None if wanted is None else list(wanted)
        known: dict[object, RingChannel] = {}
        chosen: dict[int, bool] = {}
        for segment in self.segments(from_us, to_us):
            for message in read_segment(segment.path, from_us, to_us, known):
                channel = message.channel
                if patterns is not None:
                    if id(channel) not in chosen:
                        chosen[id(channel)] = fits(patterns, channel.topic, channel.stream)
                    if not chosen[id(channel)]:
                        continue
                yield message

    def latched(self, at_us: int, wanted: Iterable[str] | None = None) -> Latched:
        """The latched messages that are in force at a time, also of before the ring's begin."""
        return self._latched.in_force(at_us, wanted)

    def drops(self, from_us: int, to_us: int) -> Sequence[Drop]:
        """What was heard in the window and is not in the ring, as far as known; also of runs before. After
        a restart, a drop of every stream says from when to when nothing was heard."""
        drops = [*self._folder.drops(), *self._ledger.drops()]
        return [drop for drop in drops if drop.from_us <= to_us and drop.to_us >= from_us]

    def counts(self) -> dict[str, Counts]:
        """The counts of each stream."""
        return self._ledger.counts()

    def report(self) -> dict[str, Any]:
        """The ring in a few numbers, for the status."""
        segments, counts = self._folder.segments(), Counts()
        for one in self.counts().values():
            counts.add(one)
        return {
            "folder": str(self._folder.path),
            "segments": len(segments),
            "mb": round(sum(segment.size for segment in segments) / 1e6, 1),
            "span_s": round((self.now_us() - self.since_us()) / 1e6, 1),
            "messages": counts.taken,
            "written": counts.written,
            "written_mb": round(self._writer.written_bytes / 1e6, 1),
            "syncs": self._writer.syncs,
            "dropped": counts.dropped,
            "latched_mb": round(self._latched.size / 1e6, 1),
            "latched_dropped": self._latched.dropped,
            "evicted_for": self.evicted_why,
            **self._throttled.counts(),
        }

    # --- life ----------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to write in a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        """Write everything and end the segment."""
        self._ending.set()
        self._kick.set()
        if self._thread.is_alive():
            self._thread.join()
        self.work(ending=True)
        self._folder.close()

    def _work_until_end(self) -> None:
        while not self._ending.is_set():
            self._clock.wait(self._kick, LOOK_S)
            self._kick.clear()
            try:
                self.work()
            except BaseException:
                # Whatever it was, the thread begins again with a segment of its own.
                self._writer.give_up()
                raise

    def work(self, *, ending: bool = False) -> None:
        """Write what waits; the thread calls it again and again."""
        with self._ledger.lock:
            flushes, self._flushes = self._flushes, []
            left = len(self._queue)
        while left:
            with self._ledger.lock:
                items = [self._queue.popleft() for _ in range(min(left, _TOGETHER))]
            left -= len(items)
            try:
                for item in items:
                    self._writer.put(item[:5], item[5])
            finally:
                with self._ledger.lock:
                    self._bytes -= sum(item[6] for item in items)
        self._writer.tick(self.now_us(), flush=bool(flushes), ending=ending)
        now = self._clock.monotonic()
        if ending or now - self._told_at >= _TELL_S:
            self._told_at = now
            self._folder.add_drops(self._ledger.drops(take=True))
        for done in flushes:
            done.set()


class _Kept:
    """The `Emit` that `Ring.around` makes."""

    def __init__(self, ring: Ring, emit: Emit, only: Container[str]) -> None:
        self._ring, self._emit, self._only = ring, emit, only

    def __call__(self, stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:
        only = self._only
        if stream == TYPES_STREAM:
            # Each message is kept with its type. Of a stream that is not recorded, too, the type is: so the
            # operator's commands know that the topic is there.
            return self._emit(stream, t_us, values, more=more)
        self._ring.take(stream, t_us, values)
        nothing = stream in only
        if isinstance(values, Selected):
            values.whole = None  # the lanes need not hold it
            nothing |= not values
        if nothing:
            return self._ring.missed_at()
        return self._emit(stream, t_us, values, more=more)


def make_ring(config: RecorderConfig, clock: Clock, *, run: str, reserve: int) -> Ring:
    """The ring of a configuration. Raises `AgentError`, as `Ring` does."""
    assert config.folder is not None, "as the configuration is loaded"
    return Ring(config, clock, folder=config.folder, run=run, reserve=reserve)
