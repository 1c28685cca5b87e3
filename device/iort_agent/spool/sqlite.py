"""The spool on disk: its batches survive the process and, if so configured, a power cut.

A batch is put into `Memory`. One thread, the only one that touches the disk, moves what waits there
into an SQLite file in one transaction: at once, but not within `GROUP_S` of the one before. `next` gives a
batch after that transaction, never before. So a published batch survives a kill and, with ``durability:
full``, a power cut. A kill costs the puts of the last `GROUP_S`.

Acknowledgements are written with the next batch, or `ACKS_S` later: to wake the thread for them costs more
than to write them. A crash may lose these, and then batches are sent again, with the same number and content.

A disk that is full, read-only or failing does not stop the agent: the spool is degraded. Batches stay where
they are, in memory, up to `MEMORY_BYTES`, and are published from there, after what can be read of
the file. The alarm says so, and writing is tried again every `RETRY_S`. A damaged file is set aside, and what
is still good in it goes into a new one.
"""

from __future__ import annotations

import functools
import logging
import sqlite3
import threading
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from typing import Callable, Iterable

from iort_agent.common.threads import Clock, Supervised
from iort_agent.errors import AgentError
from iort_agent.spool import OVERWRITE_OLDEST, PROCESS, Backlog, Dropped, Entry, OnStored, QueueConfig
from iort_agent.spool.file import (
    READ_BYTES,
    READ_ENTRIES,
    QueueLock,
    SpoolFile,
    is_damage,
    put_in_place,
    rebuild,
    rebuilt,
)
from iort_agent.spool.memory import Memory
from iort_contract.messages.batch import RunEnd

_log = logging.getLogger(__name__)

# Puts wait at most so long for their transaction, and acknowledgements, which need not hurry, so long.
GROUP_S, ACKS_S = 0.05, 2.0
# The limits of a transaction, so that SQLite's log stays small.
GROUP_ENTRIES, GROUP_BYTES = 512, 1024 * 1024
# The limit of what is not on the disk. The file may hold far more.
MEMORY_BYTES = 16 * 1024 * 1024
RETRY_S = 1.0
_SHRINK_S = 0.5
_TRIM_ENTRIES = 64
_TROUBLES = (OSError, sqlite3.Error, AgentError)


def make_spool(queue: QueueConfig, clock: Clock) -> SqliteSpool:
    """The spool of a configuration, ready for use.

    Raises `AgentError` if the file is in use by another agent or was not made by one.
    """
    assert queue.path is not None, "as the configuration is loaded"
    with suppress(OSError):  # the spool tells it, and goes on in memory
        queue.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    spool = SqliteSpool(
        queue.path, max_bytes=queue.max_bytes, policy=queue.policy, durability=queue.durability, clock=clock
    )
    spool.start()
    return spool


class SqliteSpool:
    """A `iort_agent.spool.Spool` in an SQLite file. ``max_bytes`` bounds the payloads.

    `start` begins the thread; without it, call `work`. The file is a little larger than its payloads and
    gives pages back when it has been emptied.

    Raises `AgentError` if the file is in use by another agent or was not made by one. Any other trouble with
    the file or the disk becomes an alarm.
    """

    def __init__(
        self,
        path: Path,
        *,
        max_bytes: int,
        policy: str = OVERWRITE_OLDEST,
        durability: str = PROCESS,
        clock: Clock,
        memory_bytes: int = MEMORY_BYTES,
        open_file: Callable[..., SpoolFile] = SpoolFile,
    ) -> None:
        self._path, self._max_bytes, self._overwrite = path, max_bytes, policy == OVERWRITE_OLDEST
        self._clock, self._connect = clock, functools.partial(open_file, durability=durability)
        self._memory_bytes = min(memory_bytes, max_bytes)
        self._handlers: list[OnStored] = []

        # Under _lock. First what the file does not have yet.
        self._lock = threading.Lock()
        self._memory = Memory(max_bytes=self._memory_bytes, policy=policy)
        self._ends: dict[str, RunEnd] = {}
        self._gone: set[int] = set()
        self._told: set[tuple[str, str]] = set()
        # Of what is in the file, `_page` has the unacknowledged batches up to the id `_read_to`, in order.
        self._page: OrderedDict[int, Entry] = OrderedDict()
        self._read_to = self._last_in_file = 0
        self._in_file = Backlog(0, 0, 0)
        self._wanted = False
        self._dropped = Dropped(0, 0)
        # The runs before this one, by stream; batches put after `_first_id` name them, and some have arrived.
        self._before: dict[str, tuple[RunEnd, ...]] | None = None
        self._first_id = 0
        self._arrived: set[str] = set()
        self._trouble: str | None = None
        self._damage: str | None = None
        self.damaged = 0
        self._due: float | None = None
        self._retry_at: float | None = None
        self._wrote_at = 0.0
        self._ending = self._closed = False

        # Of the thread that works.
        self._kick = threading.Event()
        self._thread = Supervised("spool", self._run)
        self._queue_lock: QueueLock | None = None
        self._file: SpoolFile | None = None
        try:
            self._attempt(self._open, OSError, sqlite3.Error)
        except AgentError:
            self._unlock()
            raise

    # --- what lanes and sources call --------------------------------------------------------------

    @property
    def alarm(self) -> str | None:
        """What is wrong with the disk or was with the file; None while all is well."""
        with self._lock:
            return "; ".join(filter(None, (self._trouble, self._damage))) or None

    @property
    def durable(self) -> bool:
        """Whether what is kept would survive; not while the disk does not work."""
        with self._lock:
            return self._trouble is None

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler, in the spool's thread, when `next` may have a batch."""
        self._handlers.append(handler)

    def previous(self, stream: str) -> tuple[RunEnd, ...] | None:
        """The runs that the cloud may not know of, as the file has them."""
        with self._lock:
            return None if stream in self._arrived else (self._before or {}).get(stream, ())

    def put(self, stream: str, boot: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch. The oldest batches are dropped with the next transaction if there is no room."""
        with self._lock:
            self._ends[stream] = RunEnd(boot, seq)
            if not self._overwrite:
                room = self._max_bytes - self._in_file.payload_bytes
                self._memory.max_bytes = min(self._memory_bytes, room)
            self._memory.put(stream, seq, payload, samples=samples)
            is_full = len(self._memory) >= GROUP_ENTRIES or self._memory.payload_bytes >= GROUP_BYTES
            waited_s = self._clock.monotonic() - self._wrote_at
            self._schedule(0.0 if is_full else max(0.0, GROUP_S - waited_s))

    def next(self, after: int) -> Entry | None:
        """The oldest durable batch after that one, if it was read; otherwise it will be read."""
        with self._lock:
            entry = next((entry for entry_id, entry in self._page.items() if entry_id > after), None)
            unread = self._read_to < self._last_in_file
            if entry is None and unread:
                self._wanted = True
                self._schedule(0.0, now=True)
            waiting = self._memory.next(after) if self._trouble is not None else None
            # A file that was opened late has its batches behind those that had waited for it.
            if waiting is not None and (waiting.id <= self._read_to or (entry is None and not unread)):
                self._read_to = max(self._read_to, waiting.id)
                return waiting if entry is None or waiting.id < entry.id else entry
            return entry

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        with self._lock:
            entry = self._page.pop(entry_id, None)
            if entry is not None:
                self._in_file = _changed(self._in_file, -1, -entry.samples, -len(entry.payload))
                self._gone.add(entry_id)
                self._schedule(ACKS_S)
            else:
                entry = self._memory.take(entry_id)
            if entry is not None and entry_id > self._first_id and entry.stream not in self._arrived:
                self._arrived.add(entry.stream)
                self._told |= {(entry.stream, end.boot) for end in (self._before or {}).get(entry.stream, ())}

    def backlog(self) -> Backlog:
        """What is kept now, in the file and in memory."""
        with self._lock:
            return Backlog(*map(sum, zip(self._in_file, self._memory.backlog())))

    def dropped(self) -> Dropped:
        """What was dropped since the start of this process, in a damaged file or by the policy."""
        with self._lock:
            return Dropped(*map(sum, zip(self._dropped, self._memory.dropped())))

    # --- life -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to write in a thread of its own."""
        self._thread.start()

    def close(self) -> None:
        """Write everything, close the file and let go of it."""
        with self._lock:
            self._ending = True
        self._kick.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._closed:
            return
        self._closed, self._retry_at = True, None
        self.work()
        if len(self._memory):
            self.work()  # into a new file, if the old one was damaged
        left = len(self._memory)
        if left:
            _log.error("queue: %d batches could not be written to %s and are lost", left, self._path)
        if self._file is not None:
            try:
                self._file.close()
            except (OSError, sqlite3.Error) as error:
                _log.warning("queue: %s could not be closed in good order: %s", self._path, error)
                self._file.abandon()
        self._unlock()

    def work(self) -> None:
        """Write and read what has come up: one pass. For the spool's thread, or instead of it."""
        with self._lock:
            self._due = None
            wrote_at, retry_at = self._wrote_at, self._retry_at
        if retry_at is None or self._clock.monotonic() >= retry_at:
            self._attempt(self._write, *_TROUBLES)
        if self._file is not None:
            self._attempt(self._read, *_TROUBLES)
        with self._lock:
            if self._retry_at is not None:
                self._schedule(0.0)
            elif len(self._memory):
                self._schedule(GROUP_S)
            elif self._gone or self._told or self._wrote_at != wrote_at:
                # What was just written is acknowledged by then, without waking the thread for it.
                self._schedule(ACKS_S)
        for handler in self._handlers:
            handler()

    # --- the thread -------------------------------------------------------------------------------

    def _schedule(self, delay_s: float, *, now: bool = False) -> None:
        """Let the thread work after the delay; while the disk does not work, not before the retry."""
        due = self._clock.monotonic() + delay_s
        if self._retry_at is not None and not now:
            due = max(due, self._retry_at)
        if self._due is None or due < self._due:
            self._due = due
            self._kick.set()

    def _run(self) -> None:
        while True:
            self._kick.clear()
            with self._lock:
                if self._ending:
                    return
                wait_s = None if self._due is None else self._due - self._clock.monotonic()
            if wait_s is None or wait_s > 0:
                self._clock.wait(self._kick, wait_s)
                continue
            try:
                self.work()
            except BaseException as error:
                # Whatever it is, batches must still go out.
                self._degrade(error)
                raise

    def _write(self) -> None:
        if self._file is None:
            self._open()
        elif self._trouble is not None and self._file.in_place():
            # An open file may have to be opened again to work again.
            fresh = self._connect(self._path)
            self._file.abandon()
            self._file = fresh
        with self._lock:
            last_id = self._memory.last_id
        # What is put meanwhile waits for the next pass: on a slow disk, `_read` would never have its turn.
        while self._write_group(last_id):
            pass
        assert self._file is not None
        if not self.backlog().batches and self._file.shrink():
            with self._lock:
                self._schedule(_SHRINK_S)
        with self._lock:
            recovered = self._trouble is not None
            self._trouble = self._retry_at = None
        if recovered:
            _log.info("%s: the disk works again, everything is written", self._path)

    def _write_group(self, last_id: int) -> bool:
        """One transaction; whether there is more to write, up to that batch."""
        assert self._file is not None
        self._trim(self._file)
        with self._lock:
            entries = self._memory.oldest(GROUP_ENTRIES, GROUP_BYTES)
            gone, told, ends = set(self._gone), set(self._told), dict(self._ends)
        if not (entries or gone or told or ends):
            return False
        self._file.commit(entries, gone=gone, ends=ends, told=told)
        with self._lock:
            self._wrote_at = self._clock.monotonic()
            self._gone -= gone
            self._told -= told
            self._ends = {stream: end for stream, end in self._ends.items() if ends.get(stream) != end}
            if entries:
                self._move_to_file(entries)
            left = self._memory.next(0)
            return left is not None and left.id <= last_id

    def _move_to_file(self, entries: list[Entry]) -> None:
        """Batches are in the file now: they leave the memory, but for those that may be wanted soon."""
        has_room = len(self._page) < READ_ENTRIES and _bytes(self._page.values()) < READ_BYTES
        if has_room and self._read_to >= self._last_in_file:
            self._read_to = max(self._read_to, entries[-1].id)
        is_behind = bool(self._page) and entries[0].id < next(reversed(self._page))
        self._last_in_file = max(self._last_in_file, entries[-1].id)
        for entry in entries:
            if self._memory.take(entry.id) is None:
                # It was acknowledged or dropped meanwhile.
                self._gone.add(entry.id)
                continue
            self._in_file = _changed(self._in_file, 1, entry.samples, len(entry.payload))
            if entry.id <= self._read_to:
                self._page[entry.id] = entry
        if is_behind:
            self._page = OrderedDict(sorted(self._page.items()))

    def _trim(self, file: SpoolFile) -> None:
        """Drop the oldest batches in the file while there are more than ``max_bytes``."""
        after = 0
        while self._overwrite and self._excess() > 0:
            oldest = file.oldest(after, _TRIM_ENTRIES)
            if not oldest:
                raise sqlite3.DatabaseError("batches are missing")
            after = oldest[-1][0]
            with self._lock:
                for entry_id, samples, size in oldest:
                    # Acknowledgements make room meanwhile.
                    if self._excess() <= 0 or entry_id in self._gone:
                        continue
                    self._gone.add(entry_id)
                    self._page.pop(entry_id, None)
                    self._in_file = _changed(self._in_file, -1, -samples, -size)
                    self._drop(1, samples)

    def _excess(self) -> int:
        return self._in_file.payload_bytes + self._memory.payload_bytes - self._max_bytes

    def _read(self) -> None:
        """Read on in the file, if `next` has come to the end of what was read."""
        with self._lock:
            after, to = self._read_to, self._last_in_file
            if not self._wanted or after >= to:
                return
        assert self._file is not None
        try:
            entries = self._file.read(after, to)
        except sqlite3.OperationalError as error:
            try:
                self._file.check_writable()
            except sqlite3.Error:
                self._lose_file()
                raise error from None
            # The disk works and no other program is in the way, so this part of the file cannot be read.
            raise sqlite3.DatabaseError(str(error)) from error
        with self._lock:
            self._wanted = False
            self._read_to = entries[-1].id if entries else to
            self._page.update((entry.id, entry) for entry in entries if entry.id not in self._gone)
            missing = self._in_file.batches - len(self._page)
            if self._read_to >= to == self._last_in_file and missing > 0:
                raise sqlite3.DatabaseError(f"{missing} batches are missing")

    # --- when the disk does not work --------------------------------------------------------------

    def _attempt(self, step: Callable[[], None], *errors: type[Exception]) -> None:
        """Do something with the file; the spool goes on in memory after one of the errors."""
        try:
            try:
                step()
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
                self._replace(error)
        except errors as error:
            self._degrade(error)

    def _degrade(self, error: BaseException) -> None:
        """The disk does not work: go on in memory."""
        text = str(error)
        if not isinstance(error, AgentError):
            text = f"the queue's disk does not work, so batches are kept in memory only: {error}"
        with self._lock:
            news = self._trouble is None
            self._trouble = text
            self._retry_at = self._clock.monotonic() + RETRY_S
            self._schedule(0.0)
        if news:
            _log.error("%s: %s", self._path, text)

    def _open(self) -> None:
        """Take the file, and go on where the run before ended."""
        if self._queue_lock is None:
            self._queue_lock = QueueLock(self._path)
        if not self._path.exists() and rebuilt(self._path).exists():
            # A kill may have left what is in it in its log.
            self._connect(rebuilt(self._path)).close()
            put_in_place(self._path)
        is_gone = self._queue_lock.ours and not self._path.exists()
        try:
            file = self._connect(self._path)
        except sqlite3.DatabaseError as error:
            if is_damage(error) and not self._queue_lock.ours:
                # It was never an agent's, so it must not be moved away.
                raise AgentError(f"{self._path}: {error}: give queue.path another name") from error
            raise
        self._take_over(file)
        if is_gone:
            self._tell_damage("the queue's file was removed, with all that it held")

    def _take_over(self, file: SpoolFile) -> None:
        """Keep what is in a file that was not open before, behind what waits in memory."""
        assert self._queue_lock is not None
        try:
            last, _ = file.totals()
            with self._lock:
                if last and self._memory.last_id:
                    file.move_ids(max(last, self._memory.last_id))
                last, in_file = file.totals()
                # Only at first: later, the file knows this run too.
                if self._before is None:
                    self._before = file.runs()
                    self._arrived.clear()
                self._read_to, self._last_in_file, self._in_file = self._memory.last_id, last, in_file
                self._memory.last_id = max(self._memory.last_id, last)
                self._first_id = self._memory.last_id
        except BaseException:
            file.abandon()
            raise
        self._file = file
        self._queue_lock.note_owner()

    def _lose_file(self) -> None:
        """Go on without the file. When it can be opened again, it counts as one that was never open."""
        assert self._file is not None
        self._file.abandon()
        self._file = None
        with self._lock:
            self._page.clear()
            self._gone.clear()
            self._in_file = Backlog(0, 0, 0)
            self._last_in_file = 0

    def _replace(self, error: Exception) -> None:
        """Set the damaged file aside, and go on with a new one and what can still be read."""
        with self._lock:
            gone, before = set(self._gone), self._in_file
        found = rebuild(self._path, self._file, gone, connect=self._connect, now_us=self._clock.now_us())
        if self._file is not None:
            self._lose_file()
        self._open()
        lost = Dropped(
            max(found.lost.batches, before.batches - found.saved.batches),
            max(found.lost.samples, before.samples - found.saved.samples),
        )
        where = f"set aside as {found.aside.name}" if found.aside is not None else "begun anew"
        text = (
            f"the queue's file was damaged ({error}) and {where}: "
            f"{found.saved.batches} batches saved, at least {lost.batches} lost"
        )
        with self._lock:
            self._drop(*lost)
            self._schedule(0.0)
        self._tell_damage(text)

    def _tell_damage(self, text: str) -> None:
        _log.error("%s: %s", self._path, text)
        with self._lock:
            self._damage = text
            self.damaged += 1

    def _drop(self, batches: int, samples: int) -> None:
        self._dropped = Dropped(self._dropped.batches + batches, self._dropped.samples + samples)

    def _unlock(self) -> None:
        if self._queue_lock is not None:
            self._queue_lock.close()
            self._queue_lock = None


def _changed(kept: Backlog, batches: int, samples: int, payload_bytes: int) -> Backlog:
    """What is kept, after so much has come or, below 0, gone."""
    return Backlog(kept.batches + batches, kept.samples + samples, kept.payload_bytes + payload_bytes)


def _bytes(entries: Iterable[Entry]) -> int:
    return sum(len(entry.payload) for entry in entries)
