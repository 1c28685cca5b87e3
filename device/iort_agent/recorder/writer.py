"""Writes the ring: messages into chunks, chunks into segments, and what to do when the disk is full or
fails."""

from __future__ import annotations

import errno
import logging
import math
from typing import Any

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.threads import Clock
from iort_agent.recorder.folder import SEGMENT_BYTES, SEGMENT_S, RingFolder
from iort_agent.recorder.latched import LatchedFolder
from iort_agent.recorder.ledger import DISK, ERROR, Entry, Ledger, Topic
from iort_agent.recorder.segment import RingMessage, SegmentFile, json_channel, json_message, ros_channel

_log = logging.getLogger(__name__)

# A chunk is closed after this time or these bytes.
CHUNK_S, CHUNK_BYTES = 0.3, 1024 * 1024
_BOUNDS_S = 1.0
# Files that wait for their sync are open.
_MOST_UNSYNCED = 32
# The numbers of a latched message that came again, which is not a new one, and of one that the memory had no
# room for: what was before it is not in force any more.
AGAIN, GONE = -1, -2
_FULL = (errno.ENOSPC, errno.EDQUOT)


class RingWriter:
    """Writes in one thread. ``file`` is the open segment.

    A chunk that cannot be written is kept in memory. The oldest segments are deleted until there is room for
    it. If that does not help, it is dropped, and so is what follows until the disk works again.
    """

    def __init__(
        self,
        folder: RingFolder,
        ledger: Ledger,
        clock: Clock,
        *,
        run: str,
        sync_s: float,
        latched: LatchedFolder,
    ) -> None:
        self._folder, self._ledger, self._clock, self._latched = folder, ledger, clock, latched
        self._run, self._sync_s = run, sync_s
        self._throttled = ThrottledLog(_log, clock)
        self.file: SegmentFile | None = None
        # What the operator should know and mend, in a line; None while all is well.
        self.alarm: str | None = None
        self.written_bytes = self.syncs = 0
        self._chunk: list[Entry] = []
        self._chunk_bytes = 0
        self._chunk_at = self._file_at = self._synced_at = clock.monotonic()
        self._bounds_at = -math.inf
        self._unsynced: list[SegmentFile] = []
        # While the disk is full or fails, until the next look at it.
        self._stopped = False

    def put(self, entry: tuple[Topic, int, int, int, Any], latched_by: str | None) -> None:
        """Add a message to the open chunk: its bytes, or a sample."""
        topic, seq, ring_us, t_us, payload = entry
        if topic.channel is None:
            if topic.kind is None:
                topic.channel = json_channel(topic.stream, payload, self._run)
            else:
                topic.channel = ros_channel(topic.stream, topic.kind, self._run)
        if latched_by is not None:
            message = RingMessage(topic.channel, max(0, seq), ring_us, t_us, payload)
            self._latched.put(message, latched_by, again=seq == AGAIN, gone=seq == GONE)
            if seq < 0:
                return
        if self._stopped:
            with self._ledger.lock:
                self._ledger.drop(topic, DISK, ring_us)
            return
        if topic.kind is None:
            payload = json_message(payload)
        if not self._chunk:
            self._chunk_at = self._clock.monotonic()
        entry = (topic, seq, ring_us, t_us, payload)
        self._chunk.append(entry)
        self._chunk_bytes += len(payload)
        try:
            self._add(entry)
        except OSError:
            self._recover()
        if self._chunk_bytes >= CHUNK_BYTES:
            self._close_chunk()

    def tick(self, now_us: int, *, flush: bool = False, ending: bool = False) -> None:
        """Close what is due, and keep the bounds; with ``flush``, the open chunk at once."""
        now = self._clock.monotonic()
        if self._chunk and (flush or ending or now - self._chunk_at >= CHUNK_S):
            self._close_chunk()
        if ending or now - self._file_at >= SEGMENT_S:
            self._end_segment()
        if not self._stopped:
            since_us = self._folder.since_us(now_us if self.file is None else self.file.from_us)
            self._unsynced += self._latched.tick(now_us, since_us, flush=flush or ending)
            self._folder.beside_bytes = self._latched.size
        if now - self._bounds_at >= _BOUNDS_S:
            self._bounds_at = now
            self._keep_bounds(now_us)
        if ending or now - self._synced_at >= self._sync_s or len(self._unsynced) > _MOST_UNSYNCED:
            self._synced_at = now
            self._sync()

    def give_up(self) -> None:
        """Drop the open chunk and leave its segment: something unforeseen went wrong."""
        self._leave_file()
        self._drop_chunk(ERROR)

    def _add(self, entry: Entry) -> None:
        topic, seq, ring_us, t_us, payload = entry
        if self.file is None:
            self.file = self._folder.begin(ring_us)
            self._file_at = self._clock.monotonic()
        assert topic.channel is not None, "as its first message made it"
        self.file.add(topic.channel, seq, ring_us, t_us, payload)

    def _close_chunk(self) -> None:
        """Write the open chunk, and end a segment that is large."""
        assert self.file is not None, "as the chunk has messages"
        before = self.file.size
        try:
            self.file.close_chunk()
        except OSError:
            self._recover()
            return
        self._wrote(self.file.size - before)
        if self.file.size >= SEGMENT_BYTES:
            self._end_segment()

    def _wrote(self, size: int) -> None:
        if self.alarm is not None:
            self.alarm = None
            _log.info("the ring keeps messages again")
        self.written_bytes += size
        self._ledger.wrote(self._chunk)
        self._chunk, self._chunk_bytes = [], 0

    def _recover(self) -> None:
        """Write the chunk into a new segment, and make room for it as long as that is what lacks."""
        while True:
            self._leave_file()
            try:
                for entry in self._chunk:
                    self._add(entry)
                assert self.file is not None, "as the chunk has messages"
                self.file.close_chunk()
            except OSError as error:
                if error.errno in _FULL and self._folder.make_room():
                    continue
                self._leave_file()
                self._stop(f"the ring cannot write to {self._folder.path}: {error.strerror or error}")
                self._drop_chunk(DISK)
            else:
                self._wrote(self.file.size)
            return

    def _end_segment(self) -> None:
        """Write the open segment's indexes: it will not change any more."""
        if self._chunk:
            self._close_chunk()
        file = self.file
        if file is None:
            return
        before = file.size
        try:
            file.finish()
        except OSError as error:
            _log.debug("the ring's segment %s has no index: %s", file.path.name, error)
            self._leave_file()
            return
        self.written_bytes += file.size - before
        self._unsynced.append(file)
        # In this order, so that a reader finds it at all times.
        self._folder.add(file)
        self.file = None

    def _leave_file(self) -> None:
        if self.file is not None:
            self.file.abandon()
            self._folder.add(self.file)
            self.file = None

    def _sync(self) -> None:
        """Bring what is written since the last time onto the medium."""
        files, self._unsynced = self._unsynced, []
        try:
            for file in [*files, *([self.file] if self.file is not None else [])]:
                self.syncs += file.sync()
            self._folder.sync()
        except OSError as error:
            self._throttled.warn("sync", f"ring: {self._folder.path}: {error.strerror or error}")
        for file in files:
            file.close()

    def _keep_bounds(self, now_us: int) -> None:
        """Delete old segments, and stop while the disk is too full even without them."""
        try:
            lacking = self._folder.evict(now_us, stopped=self._stopped)
            if lacking:
                # The open one, too, must not stand in others' way.
                self._end_segment()
                lacking = self._folder.evict(now_us, stopped=self._stopped)
        except OSError as error:
            self._stop(f"the ring's folder {self._folder.path}: {error.strerror or error}")
            return
        self._stopped = lacking > 0
        if lacking:
            self._latched.give_way(now_us)
            self._stop(
                f"the disk is full: the ring keeps nothing until {lacking / 1e6:.0f} MB more are free "
                f"({self._folder.path})"
            )

    def _stop(self, alarm: str) -> None:
        # The alarm stays until a chunk could be written.
        if self.alarm is None:
            _log.error("%s", alarm)
        self._stopped, self.alarm = True, alarm

    def _drop_chunk(self, why: str) -> None:
        self._ledger.drop_entries(self._chunk, why)
        self._chunk, self._chunk_bytes = [], 0
