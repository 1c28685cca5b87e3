"""The spool on disk: what it has taken survives the process and, if so configured, a power cut.

`put` and `ack` only note what is to be done; one thread, the only one that touches the disk, writes
what has come up in one transaction, at most `GROUP_S` later. A batch is given to `next` after that
transaction, never before, so

- no batch leaves the robot whose number a crash could give to another one;
- with ``durability: full`` a batch that is published survives a power cut, with ``process`` a kill;
- a kill costs the puts of the last `GROUP_S`, whose numbers nobody has seen and which are used again.

Acknowledgements are written in groups too. A crash may lose the last ones, and then batches are sent
again, with the same number and the same content.

A disk that is full, read-only or failing does not stop the agent: it is *adrift*. Batches stay in
memory, up to `MEMORY_BYTES`, and are published from there; the alarm says so; writing is tried again
and what waits is written when there is room. A damaged file is set aside and what is still good in it
copied into a new one. `device.reservation` keeps numbers from being used twice whatever happens to
the database.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING

from device.clock import Clock
from device.errors import AgentError
from device.ledger import Ledger, Size, Window
from device.reservation import BLOCK, BLOCK_ADRIFT, Reservation
from device.spool import (
    FULL,
    OVERWRITE_OLDEST,
    PROCESS,
    Backlog,
    Dropped,
    Entry,
    MemorySpool,
    OnStored,
    Spool,
)
from device.spool_file import Content, SpoolFile, is_damage, remove, salvage, set_aside

if TYPE_CHECKING:
    from device.config import Config

_log = logging.getLogger(__name__)

# Puts wait at most so long for their transaction, and acknowledgements, which need not hurry, so long.
GROUP_S, ACKS_S = 0.05, 0.5
# A transaction has at most so much in it, so that the log stays small.
GROUP_ENTRIES, GROUP_BYTES = 512, 1024 * 1024
# Of what is not on the disk. What is on the disk may be far more.
MEMORY_BYTES = 16 * 1024 * 1024
# Read ahead of what is being published. A connection's window of messages is 2.5 MB at most.
_AHEAD_BYTES, _WINDOW_BYTES = 512 * 1024, 4 * 1024 * 1024
# Reading goes on when only so many are left: a third of a second at the broker's limit.
_AHEAD_ENTRIES = 32
RETRY_S = 1.0


def make_spool(config: Config, clock: Clock) -> Spool:
    """The spool that the configuration asks for, ready for use.

    Raises `AgentError` where the file is in use by another agent or is none of ours.
    """
    queue = config.queue
    if queue.path is None:
        return MemorySpool(max_bytes=queue.max_bytes, policy=queue.policy)
    spool = SqliteSpool(
        queue.path, max_bytes=queue.max_bytes, policy=queue.policy, durability=queue.durability, clock=clock
    )
    spool.start()
    return spool


class SqliteSpool:
    """A `device.spool.Spool` in an SQLite file. ``max_bytes`` bounds the payloads.

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
        self._max_bytes = max_bytes
        self._overwrite = policy == OVERWRITE_OLDEST
        self._durability = durability
        self._clock = clock
        self._memory_bytes = memory_bytes
        self._max_file_bytes = max_file_bytes
        self._handlers: list[OnStored] = []

        # Under _lock: what is kept, where, and what has still to be written. Held for moments only.
        self._lock = threading.Condition()
        self._ledger = Ledger()
        self._last_id = 0
        self._pending: OrderedDict[int, Entry] = OrderedDict()
        self._pending_bytes = 0
        # Of those being written now the last id: dropped or acknowledged meanwhile, they get deleted.
        self._writing_to = 0
        self._gone: set[int] = set()
        self._seqs: dict[str, int] = {}
        self._used: set[str] = set()
        # Where streams begin that are not known: above 0 only if there are too many to know each.
        self._floor = 0
        self._dropped = self._dropped_before = Dropped(0, 0)
        self._dropped_written = Dropped(0, 0)
        self._window = Window()
        self._wanted: int | None = None
        self._ahead = False
        self._due: float | None = None
        self._retry_at: float | None = None
        self._adrift: str | None = None
        self._damage: str | None = None
        self._flush_asked = self._flush_done = 0
        self._ending = False

        # Of the thread that works.
        self._work_lock = threading.Lock()
        self._kick = threading.Event()
        self._thread = threading.Thread(target=self._run, name="spool", daemon=True)
        self._numbers: Reservation | None = None
        self._file: SpoolFile | None = None
        self._disk_to = 0
        self._set_aside_first = False
        self._closed = False
        try:
            self._open()
        except (OSError, sqlite3.Error) as error:
            self._go_adrift(error)
        except BaseException:
            self._close_files()
            raise

    # --- what lanes and sources call --------------------------------------------------------------

    @property
    def alarm(self) -> str | None:
        """What is wrong with the disk or was with the file; None while all is well."""
        with self._lock:
            return "; ".join(filter(None, (self._adrift, self._damage))) or None

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
            return self._seqs.get(stream, self._floor)

    def put(self, stream: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch; drops it or the oldest ones when there is no room."""
        size = len(payload)
        with self._lock:
            self._seqs[stream] = seq + 1
            self._used.add(stream)
            if self._make_room(size):
                self._last_id += 1
                entry = Entry(self._last_id, stream, seq, payload, samples)
                self._ledger.add(entry.id, size, samples)
                self._pending[entry.id] = entry
                self._pending_bytes += size
            else:
                self._count_dropped(1, samples)
            full = len(self._pending) >= GROUP_ENTRIES or self._pending_bytes >= GROUP_BYTES
            self._schedule(0.0 if full else GROUP_S)

    def next(self, after: int) -> Entry | None:
        """The oldest durable batch after that one, if it is in memory; otherwise it is fetched."""
        with self._lock:
            wanted = self._ledger.next(after)
            if wanted is None:
                return None
            pending = self._pending.get(wanted)
            if pending is not None:
                return pending if self._adrift is not None else None
            entry = self._window.get(wanted)
            if entry is None:
                self._wanted = wanted
                self._schedule(0.0, now=True)
            elif not self._ahead and wanted + _AHEAD_ENTRIES > self._window.last < self._disk_to:
                self._ahead = True
                self._schedule(0.0, now=True)
            return entry

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        with self._lock:
            if self._forget(entry_id) is not None:
                self._schedule(ACKS_S)

    def backlog(self) -> Backlog:
        """What is kept now."""
        with self._lock:
            ledger = self._ledger
            return Backlog(ledger.batches, ledger.samples, ledger.payload_bytes)

    def dropped(self) -> Dropped:
        """What was dropped since the start of this process, in a damaged file or by the policy."""
        with self._lock:
            return self._dropped

    def dropped_ever(self) -> Dropped:
        """What was dropped since the spool was made."""
        with self._lock:
            return self._dropped_ever()

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
            return not (self._pending or self._gone or self._used)

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
            left = len(self._pending)
            if left:
                _log.error("queue: %d batches could not be written to %s and are lost", left, self._path)
        try:
            if self._file is not None and self._adrift is None:
                self._file.close()
                self._file = None
                if self._numbers is not None:
                    self._numbers.write(clean=True)
        except (OSError, sqlite3.Error) as error:
            _log.warning("queue: %s could not be closed in good order: %s", self._path, error)
        self._close_files()

    # --- under _lock ------------------------------------------------------------------------------

    def _make_room(self, size: int) -> bool:
        memory = min(self._memory_bytes, self._max_bytes)
        if size > memory:
            return False
        if not self._overwrite:
            fits = self._ledger.payload_bytes + size <= self._max_bytes
            return fits and self._pending_bytes + size <= memory
        while self._ledger.payload_bytes + size > self._max_bytes:
            self._drop(next(iter(self._ledger)))
        # The oldest are on the disk, which does not keep up; dropping those would free no memory.
        while self._pending_bytes + size > memory:
            self._drop(next(iter(self._pending)))
        return True

    def _drop(self, entry_id: int) -> None:
        size = self._forget(entry_id)
        if size is not None:
            self._count_dropped(1, size.samples)

    def _count_dropped(self, batches: int, samples: int) -> None:
        self._dropped = Dropped(self._dropped.batches + batches, self._dropped.samples + samples)

    def _dropped_ever(self) -> Dropped:
        before, now = self._dropped_before, self._dropped
        return Dropped(before.batches + now.batches, before.samples + now.samples)

    def _forget(self, entry_id: int) -> Size | None:
        size = self._ledger.remove(entry_id)
        if size is None:
            return None
        self._window.remove(entry_id)
        pending = self._pending.pop(entry_id, None)
        if pending is not None:
            self._pending_bytes -= size.payload_bytes
        if pending is None or entry_id <= self._writing_to:
            self._gone.add(entry_id)
        return size

    def _read_nothing(self, disk_to: int) -> None:
        """Begin to read ahead anew; the last batch on the disk is that one."""
        self._disk_to = disk_to
        if disk_to:
            self._window.clear()
        else:
            self._window.begin(1)

    def _schedule(self, delay_s: float, *, now: bool = False) -> None:
        """Let the thread work after the delay; while the disk does not work, not before the retry."""
        due = self._clock.monotonic() + delay_s
        if self._retry_at is not None and not now:
            due = max(due, self._retry_at)
        if self._due is None or due < self._due:
            self._due = due
            self._kick.set()

    # --- the thread -------------------------------------------------------------------------------

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
            except Exception as error:  # noqa: BLE001
                # Whatever it is, batches must still go out.
                _log.exception("queue: the thread failed, and goes on")
                self._go_adrift(error)

    def _work(self, *, force: bool) -> None:
        """Do what has come up: one pass."""
        with self._work_lock:
            with self._lock:
                self._due = None
                asked = self._flush_asked
                force = force or asked > self._flush_done
                early = self._retry_at is not None and self._clock.monotonic() < self._retry_at
            if force or not early:
                self._write_all()
            if self._file is not None:
                self._fetch()
            with self._lock:
                if self._retry_at is not None:
                    self._schedule(0.0)
                elif self._pending or self._gone:
                    self._schedule(GROUP_S if self._pending else ACKS_S)
                self._flush_done = asked
                self._lock.notify_all()
        for handler in self._handlers:
            handler()

    def _write_all(self) -> None:
        try:
            if self._adrift is not None:
                self._reopen()
            while self._write_group():
                pass
            self._shrink()
            self._settle()
        except (OSError, sqlite3.Error) as error:
            self._fail(error)
        except AgentError as error:
            # When the file is opened again: somebody else has taken it meanwhile.
            self._go_adrift(error)

    def _write_group(self) -> bool:
        """One transaction; whether there is more to write."""
        assert self._file is not None
        with self._lock:
            group: list[Entry] = []
            size = 0
            for entry in self._pending.values():
                group.append(entry)
                size += len(entry.payload)
                if len(group) >= GROUP_ENTRIES or size >= GROUP_BYTES:
                    break
            gone, self._gone = self._gone, set()
            used, self._used = self._used, set()
            seqs = {stream: self._seqs[stream] for stream in used}
            dropped = self._dropped_ever()
            new_dropped = dropped if dropped != self._dropped_written else None
            if not (group or gone or seqs or new_dropped):
                return False
            self._writing_to = group[-1].id if group else 0
        try:
            self._reserve(seqs, BLOCK)
            self._file.commit(group, gone=gone, seqs=seqs, dropped=new_dropped)
        except BaseException:
            with self._lock:
                self._gone |= gone
                self._used |= used
                self._writing_to = 0
            raise
        with self._lock:
            self._dropped_written = dropped
            self._writing_to = 0
            self._stored(group)
            return bool(self._pending)

    def _shrink(self) -> None:
        """Give the disk back what an outage took, a little at a time."""
        with self._lock:
            empty = not self._ledger.batches
        if empty and self._file is not None and self._file.shrink():
            with self._lock:
                self._schedule(ACKS_S)

    def _stored(self, group: list[Entry]) -> None:
        """A group is on the disk: it may be published, from memory while the window has room."""
        kept = [entry for entry in group if self._pending.pop(entry.id, None) is not None]
        self._pending_bytes -= sum(len(entry.payload) for entry in kept)
        if not group:
            return
        last, before = group[-1].id, self._disk_to
        self._disk_to = max(before, last)
        if group[0].id <= before:
            # The file was opened late: what had waited in memory comes before what was in it.
            self._window.clear()
        elif self._window.last >= before and self._window.payload_bytes < _WINDOW_BYTES // 2:
            self._window.extend(kept, last)

    def _fetch(self) -> None:
        """Read what `next` asked for, or what it will soon ask for."""
        with self._lock:
            wanted, self._wanted = self._wanted, None
            ahead, self._ahead = self._ahead, False
            window = self._window
            if wanted is not None and wanted in self._ledger and window.get(wanted) is None:
                first, afresh = wanted, True
            elif ahead and window.last < self._disk_to and window.payload_bytes < _WINDOW_BYTES // 2:
                first, afresh = window.last + 1, False
            else:
                return
        assert self._file is not None
        try:
            entries = self._file.read(first, _AHEAD_BYTES)
            with self._lock:
                if afresh and first in self._ledger and (not entries or entries[0].id != first):
                    raise sqlite3.DatabaseError(f"batch {first} is missing")
        except sqlite3.Error as error:
            if "locked" in str(error):
                with self._lock:
                    self._wanted = wanted
                    self._schedule(RETRY_S, now=True)
            else:
                # What cannot be read is as good as damaged, whatever the reason.
                self._replace(error)
            return
        with self._lock:
            if afresh:
                window.begin(first)
            size = sum(len(entry.payload) for entry in entries)
            last = entries[-1].id if size >= _AHEAD_BYTES else self._disk_to
            window.extend((entry for entry in entries if entry.id in self._ledger), last)
            window.shrink(_WINDOW_BYTES, keep_from=first)

    # --- the files --------------------------------------------------------------------------------

    def _connect(self) -> SpoolFile:
        return SpoolFile(self._path, durability=self._durability, max_file_bytes=self._max_file_bytes)

    def _open(self) -> None:
        """Take the files, and go on where the run before ended.

        Raises `AgentError` where they are another's, `OSError` or `sqlite3.Error` where the disk does
        not work.
        """
        if self._numbers is None:
            self._numbers = Reservation(self._path.with_name(f"{self._path.name}.seq"))
        before, machine = self._numbers.state, _machine()
        power_cut = not before.get("clean", True) and before.get("machine") != machine
        # Whether numbers may have been used that the database does not know of.
        astray = (
            bool(before.get("adrift"))
            or (power_cut and before.get("durability") != FULL)
            or not self._path.exists()
        )
        try:
            if astray:
                # Before a new file is made, which by itself would look like one that can be trusted.
                self._numbers.write(adrift=True)
            file, content = self._connect_and_load(check=power_cut)
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            if not self._numbers.existed:
                # It was never ours, so it must not be moved away.
                raise AgentError(f"{self._path}: {error}: give queue.path another name") from error
            self._numbers.write(adrift=True)
            aside = set_aside(self._path, self._clock.now_us())
            file = self._connect()
            salvaged = salvage(aside, file)
            content = file.load()
            astray = True
            with self._lock:
                self._count_dropped(len(salvaged.lost), sum(salvaged.lost.values()))
            self._tell_damage(error, aside, saved=len(salvaged.saved), lost=len(salvaged.lost))
        self._set_aside_first = False
        self._take_over(file, content, astray=astray)
        # The database first: as long as it does not know where to go on, the file of numbers says so.
        file.commit([], seqs=self._seqs, dropped=self._dropped_ever())
        self._numbers.write(clean=False, adrift=False, machine=machine, durability=self._durability)
        self._file = file

    def _connect_and_load(self, *, check: bool) -> tuple[SpoolFile, Content]:
        if self._set_aside_first:
            raise sqlite3.DatabaseError("it could not be read")
        file = self._connect()
        try:
            if check:
                file.check()
            return file, file.load()
        except BaseException:
            file.abandon()
            raise

    def _take_over(self, file: SpoolFile, content: Content, *, astray: bool) -> None:
        assert self._numbers is not None
        batches = content.batches
        with self._lock:
            if batches and self._last_id:
                # The agent has run without the file, and its ids are taken.
                offset = max(self._last_id, batches[-1][0])
                file.move_ids(offset)
                batches = [(entry_id + offset, size, samples) for entry_id, size, samples in batches]
            for batch in batches:
                self._ledger.add(*batch)
                self._last_id = batch[0]
            self._read_nothing(self._last_id if batches else 0)
            self._dropped_before = content.dropped
            if astray:
                told = Dropped(*self._numbers.state.get("dropped", (0, 0)))
                self._dropped_before = max(content.dropped, told)
                self._floor = self._numbers.reserved("")
                for stream in {*self._numbers.streams(), *content.seqs}:
                    content.seqs[stream] = max(content.seqs.get(stream, 0), self._numbers.reserved(stream))
            for stream, seq in content.seqs.items():
                self._seqs[stream] = max(self._seqs.get(stream, 0), seq)

    def _reopen(self) -> None:
        """After a failure: an open file may have to be opened again to work again."""
        if self._file is None:
            self._open()
        elif self._adrift is not None and "full" not in self._adrift:
            fresh = self._connect()
            self._file.abandon()
            self._file = fresh

    def _replace(self, error: Exception) -> None:
        """Set the damaged file aside and begin a new one with what can still be read."""
        with self._lock:
            on_disk = [entry_id for entry_id in self._ledger if entry_id not in self._pending]
        old, self._file = self._file, None
        removed = old is not None and not old.in_place()
        if old is not None and not removed:
            old.abandon()
        saved: set[int] = set()
        trouble: Exception | None = None
        where: Path | None = None
        self._set_aside_first = True
        try:
            if self._numbers is not None:
                self._numbers.write(adrift=True)
            if old is not None and removed:
                saved = self._rescue(old, on_disk)
            where = set_aside(self._path, self._clock.now_us())
            if old is not None and removed:
                self._rescued.replace(self._path)
            self._set_aside_first = False
            file = self._connect()
            if not removed:
                saved = set(salvage(where, file, on_disk).saved)
            with self._lock:
                seqs = dict(self._seqs)
            file.commit([], seqs=seqs)
            if self._numbers is not None and self._adrift is None:
                self._numbers.write(adrift=False)
            self._file = file
        except (OSError, sqlite3.Error) as another:
            # What could be saved is found when the file is opened again.
            trouble, saved = another, set()
        lost = 0
        with self._lock:
            for entry_id in on_disk:
                if entry_id not in saved and entry_id in self._ledger:
                    self._drop(entry_id)
                    lost += 1
            self._read_nothing(max(saved, default=0))
            self._gone.intersection_update(saved)
            self._dropped_written = Dropped(-1, -1)
        self._tell_damage(error, where, saved=len(saved), lost=lost)
        if trouble is not None:
            self._go_adrift(trouble)
        with self._lock:
            self._schedule(0.0)

    @property
    def _rescued(self) -> Path:
        return self._path.with_name(f"{self._path.name}.new")

    def _rescue(self, old: SpoolFile, ids: list[int]) -> set[int]:
        """Copy the batches from a file that was removed, which who has it open can still read.

        Under another name, because SQLite removes a log by its name when it closes the old file.
        """
        remove(self._rescued)
        file = SpoolFile(self._rescued, durability=self._durability, max_file_bytes=self._max_file_bytes)
        try:
            saved = set(salvage(old, file, ids).saved)
            file.close()
        finally:
            file.abandon()
        return saved

    def _tell_damage(self, error: Exception, aside: Path | None, *, saved: int, lost: int) -> None:
        there = aside is not None and aside.exists()
        where = f"set aside as {aside.name}" if aside is not None and there else "begun anew"
        text = (
            f"the queue's file was damaged ({error}) and {where}: {saved} batches saved, at least {lost} lost"
        )
        _log.error("%s: %s", self._path, text)
        with self._lock:
            self._damage = text

    def _reserve(self, seqs: dict[str, int], block: int, *, left: int = 0, **facts: object) -> None:
        """Have more numbers reserved for the streams of which no more than ``left`` are."""
        assert self._numbers is not None
        numbers = self._numbers
        reserve = {
            stream: seq + block for stream, seq in seqs.items() if seq + left > numbers.reserved(stream)
        }
        if reserve or any(numbers.state.get(name) != fact for name, fact in facts.items()):
            numbers.write(reserve=reserve, dropped=self._dropped_ever(), **facts)

    def _fail(self, error: Exception) -> None:
        if is_damage(error):
            self._replace(error)
        else:
            self._go_adrift(error)

    def _go_adrift(self, error: Exception) -> None:
        """The disk does not work: go on in memory, and note, if that works, that numbers get used."""
        with self._lock:
            seqs = dict(self._seqs)
        try:
            if self._numbers is not None:
                self._reserve(seqs, BLOCK_ADRIFT, left=BLOCK_ADRIFT // 2, adrift=True)
        except OSError as another:
            _log.debug("queue: the numbers cannot be noted either: %s", another)
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
            if self._adrift is None or self._pending or self._gone or self._used:
                return
            self._adrift = self._retry_at = None
        assert self._numbers is not None
        self._numbers.write(adrift=False)
        _log.info("%s: the disk works again, everything is written", self._path)

    def _close_files(self) -> None:
        if self._file is not None:
            self._file.abandon()
        if self._numbers is not None:
            self._numbers.close()
        self._file = self._numbers = None


def _machine() -> str:
    """Which run of the machine it is: another one after a power cut."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
