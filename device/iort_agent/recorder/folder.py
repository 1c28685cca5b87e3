"""The ring's folder: its segments, their bounds, and a list of what was heard and is not in them.

The oldest segments are deleted for room: for what ``max_mb`` and ``max_disk_share`` allow, for ``max_age_s``,
and while less of the disk is free than belongs to others, the queue above all.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import threading
from contextlib import suppress
from pathlib import Path
from typing import Iterable, NamedTuple, Sequence

from iort_agent.errors import AgentError
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.segment import Segment, SegmentFile, last_us

_log = logging.getLogger(__name__)

# A segment is closed after these bytes or this time, and then it may be deleted.
SEGMENT_BYTES, SEGMENT_S = 8 * 1024 * 1024, 10.0
# What a segment takes at most, as the last chunk may make it a little larger.
LEAST_BYTES = SEGMENT_BYTES + 2 * 1024 * 1024
# Why the oldest segment was deleted.
SIZE, AGE, SHARE, FULL = "max_mb", "max_age_s", "max_disk_share", "disk full"
_NAME = re.compile(r"(\d{8,})-(\d+)\.mcap")
# Lines of the list of drops; older ones are forgotten.
_MOST_DROPS = 2000
# Messages may come this long after others that arrived later.
SLACK_US = 1_000_000


class Drop(NamedTuple):
    """Messages of a topic that were heard between two times of the ring, and are not in it. After a restart
    of the agent, one with the stream `EVERY` says from when to when nothing was heard."""

    stream: str
    topic: str
    from_us: int
    to_us: int
    messages: int
    why: str


EVERY, RESTART = "*", "restart"


class RingFolder:
    """The folder of one process. Only the ring's thread changes it; others may read it meanwhile.

    Raises `AgentError` if it cannot be made, or if another process uses it.
    """

    def __init__(self, folder: Path, config: RecorderConfig, *, reserve: int) -> None:
        self.path, self._config = folder, config
        self._reserve = max(round(config.keep_free_mb * 1e6), reserve)
        self._lock = threading.Lock()
        # Up to when, in the ring's time, and why.
        self.evicted_us, self.evicted_why = 0, ""
        # What the ring has beside its segments, within the same bound.
        self.beside_bytes = 0
        self._synced = True
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock_fd = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise AgentError(f"recorder: {folder}: {error.strerror}") from error
        try:
            fcntl.flock(self._lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock_fd)
            raise AgentError(f"recorder: {folder} is in use by another process") from error
        # Oldest first. The last one's end is read; the others end where the next begins.
        self._segments = _segments(folder)
        self._next = 1 + max((_number(segment.path) for segment in self._segments), default=-1)
        self._drops_file = folder / "drops.jsonl"
        self._drops = _read_drops(self._drops_file)
        self._unwritten: list[Drop] = []

    # --- segments ----------------------------------------------------------------------------------

    def segments(self) -> Sequence[Segment]:
        """The closed segments, oldest first."""
        with self._lock:
            return tuple(self._segments)

    def since_us(self, began_us: int) -> int:
        """The earliest time that is still there; ``began_us`` if nothing was evicted."""
        segments = self.segments()
        return segments[0].from_us if segments else max(began_us, self.evicted_us)

    def begin(self, from_us: int) -> SegmentFile:
        """Begin a segment, with room for a whole one. Raises `OSError`."""
        self._fit()
        path = self.path / f"{self._next:08d}-{from_us}.mcap"
        self._next += 1
        self._synced = False
        return SegmentFile(path, from_us, compression=self._config.compression)

    def add(self, file: SegmentFile) -> None:
        """Take a segment that will not change any more."""
        if file.size:
            with self._lock:
                self._segments.append(Segment(file.path, file.from_us, file.to_us, file.size, closed=True))
        else:
            _delete(file.path)

    def sync(self) -> None:
        """The names of new segments survive a power cut now. Raises `OSError`."""
        if not self._synced:
            fd = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(fd)
            finally:
                os.close(fd)
            self._synced = True

    # --- bounds ------------------------------------------------------------------------------------

    def evict(self, now_us: int, *, stopped: bool) -> int:
        """Delete what the bounds do not allow; the bytes of the disk that others lack even so, 0 if none. A
        ring that ``stopped`` needs room for a segment, too, so that it does not begin in vain.
        Raises `OSError`."""
        self._fit()
        since_us = now_us - round(self._config.max_age_s * 1e6)
        while self._segments and self._segments[0].to_us < since_us:
            self._evict_one(AGE)
        reserve = self._reserve + (LEAST_BYTES if stopped else 0)
        while True:
            disk = os.statvfs(self.path)
            lacking = reserve - disk.f_bavail * disk.f_frsize
            if lacking <= 0 or not self._evict_one(FULL):
                return max(0, lacking)

    def _fit(self) -> None:
        config, disk = self._config, os.statvfs(self.path)
        allowed, why = round(config.max_mb * 1e6), SIZE
        share = round(config.max_disk_share * disk.f_blocks * disk.f_frsize)
        if share < allowed:
            allowed, why = share, SHARE
        while self._bytes() > max(0, allowed - LEAST_BYTES) and self._evict_one(why):
            pass

    def make_room(self) -> bool:
        """Delete the oldest segment, for a disk that is full; whether there was one."""
        return self._evict_one(FULL)

    def _bytes(self) -> int:
        return self.beside_bytes + sum(segment.size for segment in self._segments)

    def _evict_one(self, why: str) -> bool:
        with self._lock:
            if not self._segments:
                return False
            _delete(self._segments[0].path)
            self.evicted_us = max(self.evicted_us, self._segments.pop(0).to_us)
        self.evicted_why = why
        return True

    # --- drops -------------------------------------------------------------------------------------

    def drops(self) -> Sequence[Drop]:
        """What was dropped, oldest first."""
        with self._lock:
            return tuple(self._drops)

    def add_drops(self, drops: Iterable[Drop]) -> None:
        """Note what was dropped, on disk too as soon as it works."""
        drops = list(drops)
        with self._lock:
            self._drops = [*self._drops, *drops][-_MOST_DROPS:]
        self._unwritten = [*self._unwritten, *drops][-_MOST_DROPS:]
        if not self._unwritten:
            return
        with suppress(OSError):
            if self._drops_file.exists() and self._drops_file.stat().st_size > _MOST_DROPS * 200:
                kept = self._drops_file.with_suffix(".part")
                kept.write_text(_lines(self._drops[: -len(self._unwritten)]), encoding="utf-8")
                kept.replace(self._drops_file)
            with self._drops_file.open("a", encoding="utf-8") as file:
                file.write(_lines(self._unwritten))
            self._unwritten = []

    def close(self) -> None:
        """Let go of the folder."""
        os.close(self._lock_fd)


def _delete(path: Path) -> None:
    with suppress(FileNotFoundError):
        path.unlink()


def _number(path: Path) -> int:
    return int(path.name.partition("-")[0])


def _segments(folder: Path) -> list[Segment]:
    """The segments that earlier runs left."""
    named = sorted(
        (int(match[1]), int(match[2]), path)
        for path in folder.iterdir()
        for match in [_NAME.fullmatch(path.name)]
        if match is not None
    )
    segments = []
    for i, (_, from_us, path) in enumerate(named):
        following = named[i + 1][1] if i + 1 < len(named) else last_us(path)
        to_us = max(from_us, following if following is not None else from_us)
        segments.append(Segment(path, from_us, to_us, path.stat().st_size, closed=True))
    return segments


def _lines(drops: Iterable[Drop]) -> str:
    return "".join(json.dumps(drop) + "\n" for drop in drops)


def _read_drops(path: Path) -> list[Drop]:
    drops = []
    with suppress(OSError):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, TypeError):  # a line that a power cut tore
                drops.append(Drop(*json.loads(line)))
    return drops[-_MOST_DROPS:]
