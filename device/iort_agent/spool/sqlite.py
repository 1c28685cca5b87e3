"""The spool on disk: what it has taken survives the process and, if so configured, a power cut.

`put` and `ack` only note what is to be done; one thread, the only one that touches the disk, writes
what has come up in one transaction: at once, but not within `GROUP_S` of the one before. A batch is given
to `next` after that transaction, never before, so

- no batch leaves the robot whose number a crash could give to another one;
- with ``durability: full`` a batch that is published survives a power cut, with ``process`` a kill;
- a kill costs the puts of the last `GROUP_S`, whose numbers nobody has seen and which are used again.

Acknowledgements are written with the next batch, or `ACKS_S` later: to wake the thread for them costs
more than to write them. A crash may lose those, and then batches are sent again, with the same number
and the same content.

A disk that is full, read-only or failing does not stop the agent: it is *adrift*. Batches stay in
memory, up to `MEMORY_BYTES`, and are published from there; the alarm says so; writing is tried again
and what waits is written when there is room. A damaged file is set aside and what is still good in it
copied into a new one (`iort_agent.spool.disk`). `iort_agent.spool.reservation` keeps numbers from being
used twice whatever happens to the database.

Here is the thread and who may wait for it; what is kept is in `iort_agent.spool.stock`.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from pathlib import Path

from iort_agent.clock import Clock
from iort_agent.errors import AgentError
from iort_agent.spool.config import QueueConfig
from iort_agent.spool.disk import SpoolDisk
from iort_agent.spool.file import is_damage
from iort_agent.spool.memory import (
    OVERWRITE_OLDEST,
    PROCESS,
    Backlog,
    Dropped,
    Entry,
    MemorySpool,
    OnStored,
    Spool,
)
from iort_agent.spool.stock import AHEAD_BYTES, Stock

_log = logging.getLogger(__name__)

# Puts wait at most so long for their transaction, and acknowledgements, which need not hurry, so long.
GROUP_S, ACKS_S = 0.05, 2.0
_SHRINK_S = 0.5
# Of what is not on the disk. What is on the disk may be far more.
MEMORY_BYTES = 16 * 1024 * 1024
RETRY_S = 1.0


def make_spool(queue: QueueConfig, clock: Clock) -> Spool:
    """The spool that the configuration asks for, ready for use.

    Raises `AgentError` where the file is in use by another agent or is none of ours.
    """
    if queue.path is None:
        return MemorySpool(max_bytes=queue.max_bytes, policy=queue.policy)
    spool = SqliteSpool(
        queue.path, max_bytes=queue.max_bytes, policy=queue.policy, durability=queue.durability, clock=clock
    )
    spool.start()
    return spool


class SqliteSpool:
    """A `iort_agent.spool.memory.Spool` in an SQLite file. ``max_bytes`` bounds the payloads.

    `start` begins the thread; without it, `flush` does its work in the calling one. The file is a
    little larger than its payloads and gives pages back when it has been emptied; ``max_file_bytes``
    bounds it for good, as a full disk would.

    Raises `AgentError` where the file is in use by another agent or is none of ours. Whatever else is
    wrong with it or the disk becomes an alarm.
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
        max_file_bytes: int | None = None,
    ) -> None:
        self._path = path
        self._clock = clock
        self._handlers: list[OnStored] = []

        # Under _lock, which is held for moments only.
        self._lock = threading.Condition()
        self._stock = Stock(
            max_bytes=max_bytes, memory_bytes=memory_bytes, overwrite=policy == OVERWRITE_OLDEST
        )
        self._due: float | None = None
        self._wrote_at = 0.0
        self._retry_at: float | None = None
        self._adrift: str | None = None
        self._flush_asked = self._flush_done = 0
        self._ending = False

        # Of the thread that works.
        self._work_lock = threading.Lock()
        self._kick = threading.Event()
        self._thread = threading.Thread(target=self._run, name="spool", daemon=True)
        self._disk = SpoolDisk(
            path,
            stock=self._stock,
            lock=self._lock,
            durability=durability,
            clock=clock,
            max_file_bytes=max_file_bytes,
        )
        self._closed = False
        try:
            self._disk.open()
        except (OSError, sqlite3.Error) as error:
            self._go_adrift(error)
        except BaseException:
            self._disk.close()
            raise

    # --- what lanes and sources call --------------------------------------------------------------

    @property
    def alarm(self) -> str | None:
        """What is wrong with the disk or was with the file; None while all is well."""
        with self._lock:
            return "; ".join(filter(None, (self._adrift, self._disk.damage))) or None

    @property
    def durable(self) -> bool:
        """Whether what is kept would survive; not while the disk does not work."""
        with self._lock:
            return self._adrift is None

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler, in the spool's thread, when `next` may have a batch."""
        self._handlers.append(handler)

    def next_seq(self, stream: str) -> int:
        """The number for the stream's next batch, behind all that were used in runs before."""
        with self._lock:
            return self._stock.next_seq(stream)

    def put(self, stream: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch; drops it or the oldest ones when there is no room."""
        with self._lock:
            self._stock.put(stream, seq, payload, samples)
            waited_s = self._clock.monotonic() - self._wrote_at
            self._schedule(0.0 if self._stock.group_is_full else max(0.0, GROUP_S - waited_s))

    def next(self, after: int) -> Entry | None:
        """The oldest durable batch after that one, if it is in memory; otherwise it is fetched."""
        with self._lock:
            entry, reading = self._stock.next(after, unwritten=self._adrift is not None)
            if reading:
                self._schedule(0.0, now=True)
            return entry

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        with self._lock:
            if self._stock.forget(entry_id) is not None:
                self._schedule(ACKS_S)

    def backlog(self) -> Backlog:
        """What is kept now."""
        with self._lock:
            return self._stock.backlog()

    def dropped(self) -> Dropped:
        """What was dropped since the start of this process, in a damaged file or by the policy."""
        with self._lock:
            return self._stock.dropped

    def dropped_ever(self) -> Dropped:
        """What was dropped since the spool was made."""
        with self._lock:
            return self._stock.dropped_ever()

    # --- life -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to write in a thread of its own."""
        self._thread.start()

    def flush(self, timeout_s: float = 10.0) -> bool:
        """Write what was put and acknowledged until now, and fetch what `next` asked for.

        Whether all of it is on the disk.
        """
        if not self._thread.is_alive():
            self._work(force=True)
        else:
            with self._lock:
                self._flush_asked += 1
                asked = self._flush_asked
                self._schedule(0.0, now=True)
                self._lock.wait_for(lambda: self._flush_done >= asked, timeout_s)
        with self._lock:
            return not self._stock.unwritten

    def close(self) -> None:
        """Write everything, close the file and let go of it."""
        with self._lock:
            self._ending = True
        self._kick.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._closed:
            return
        self._closed = True
        self._work(force=True)
        with self._lock:
            left = len(self._stock.pending)
            if left:
                _log.error("queue: %d batches could not be written to %s and are lost", left, self._path)
        try:
            if self._adrift is None:
                self._disk.settle()
        except (OSError, sqlite3.Error) as error:
            _log.warning("queue: %s could not be closed in good order: %s", self._path, error)
        self._disk.close()

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
                self._work(force=False)
            except Exception as error:  # noqa: BLE001 - the thread has to live
                # Whatever it is, batches must still go out.
                _log.exception("queue: the thread failed, and goes on")
                self._go_adrift(error)

    def _work(self, *, force: bool) -> None:
        """Do what has come up: one pass."""
        with self._work_lock:
            with self._lock:
                self._due = None
                wrote_at = self._wrote_at
                asked = self._flush_asked
                force = force or asked > self._flush_done
                early = self._retry_at is not None and self._clock.monotonic() < self._retry_at
            if force or not early:
                self._write_all()
            if self._disk.file is not None:
                self._fetch()
            with self._lock:
                if self._retry_at is not None:
                    self._schedule(0.0)
                elif self._stock.pending:
                    self._schedule(GROUP_S)
                elif self._stock.acknowledged or self._wrote_at != wrote_at:
                    # What was just written is acknowledged by then, without waking the thread for it.
                    self._schedule(ACKS_S)
                self._flush_done = asked
                self._lock.notify_all()
        for handler in self._handlers:
            handler()

    def _write_all(self) -> None:
        try:
            if self._adrift is not None:
                self._disk.reopen(full="full" in self._adrift)
            while self._write_group():
                pass
            self._shrink()
            self._settle()
        except (OSError, sqlite3.Error) as error:
            if is_damage(error):
                self._replace(error)
            else:
                self._go_adrift(error)
        except AgentError as error:
            # When the file is opened again: somebody else has taken it meanwhile.
            self._go_adrift(error)

    def _write_group(self) -> bool:
        """One transaction; whether there is more to write."""
        with self._lock:
            group = self._stock.take_group()
        if group is None:
            return False
        try:
            self._disk.write(group)
        except BaseException:
            with self._lock:
                self._stock.not_written(group)
            raise
        with self._lock:
            self._stock.written(group)
            self._wrote_at = self._clock.monotonic()
            return bool(self._stock.pending)

    def _shrink(self) -> None:
        """Give the disk back what an outage took, a little at a time."""
        with self._lock:
            empty = not self._stock.backlog().batches
        if empty and self._disk.file is not None and self._disk.file.shrink():
            with self._lock:
                self._schedule(_SHRINK_S)

    def _fetch(self) -> None:
        """Read what `next` asked for, or what it will soon ask for."""
        with self._lock:
            wish = self._stock.wish()
        if wish is None:
            return
        assert self._disk.file is not None
        try:
            entries = self._disk.file.read(wish.first, AHEAD_BYTES)
            with self._lock:
                if self._stock.lacks(wish, entries):
                    raise sqlite3.DatabaseError(f"batch {wish.first} is missing")
        except sqlite3.Error as error:
            if "locked" in str(error):
                with self._lock:
                    self._stock.ask_again(wish)
                    self._schedule(RETRY_S, now=True)
            else:
                # What cannot be read is as good as damaged, whatever the reason.
                self._replace(error)
            return
        with self._lock:
            self._stock.read(wish, entries)

    # --- when the disk does not work --------------------------------------------------------------

    def _replace(self, error: Exception) -> None:
        """Go on with a new file, and what of the damaged one can still be read."""
        trouble = self._disk.replace(error, adrift=self._adrift is not None)
        if trouble is not None:
            self._go_adrift(trouble)
        with self._lock:
            self._schedule(0.0)

    def _go_adrift(self, error: Exception) -> None:
        """The disk does not work: go on in memory."""
        self._disk.note_adrift()
        text = str(error)
        if not isinstance(error, AgentError):
            text = f"the queue's disk does not work, so batches are kept in memory only: {error}"
        with self._lock:
            news = self._adrift is None
            self._adrift = text
            self._retry_at = self._clock.monotonic() + RETRY_S
            self._schedule(0.0)
        if news:
            _log.error("%s: %s", self._path, text)

    def _settle(self) -> None:
        """After everything could be written: the disk works again."""
        with self._lock:
            # From here on nothing is published that is not written. Until here, it may have been.
            if self._adrift is None or self._stock.unwritten:
                return
            self._adrift = self._retry_at = None
        self._disk.note_settled()
        _log.info("%s: the disk works again, everything is written", self._path)
