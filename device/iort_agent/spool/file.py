"""The spool's SQLite file: its tables, the lock beside it, and a new file made of a damaged one."""

from __future__ import annotations

import contextlib
import datetime as dt
import fcntl
import os
import sqlite3
import zlib
from pathlib import Path
from typing import Callable, Collection, Iterable, Mapping, NamedTuple

from iort_agent.common.private_files import make_private
from iort_agent.errors import AgentError
from iort_agent.spool import FULL, Backlog, Dropped, Entry
from iort_contract.messages.batch import MAX_PREVIOUS, RunEnd

_APPLICATION_ID = 0x696F7274  # "iort"
_VERSION = 2
# The index lets a start count the batches without reading the payloads.
_SCHEMA = f"""
BEGIN;
CREATE TABLE batches (
    id INTEGER PRIMARY KEY, stream TEXT NOT NULL, seq INTEGER NOT NULL, samples INTEGER NOT NULL,
    bytes INTEGER NOT NULL, crc INTEGER NOT NULL, payload BLOB NOT NULL
);
CREATE INDEX sizes ON batches (id, bytes, samples);
CREATE TABLE runs (
    stream TEXT NOT NULL, boot TEXT NOT NULL, last_seq INTEGER NOT NULL, PRIMARY KEY (stream, boot)
);
PRAGMA application_id = {_APPLICATION_ID};
PRAGMA user_version = {_VERSION};
COMMIT;
"""
# The write-ahead log is cut to this after a checkpoint, which comes every 1,000 pages.
_LOG_BYTES = 4 * 1024 * 1024
# How long to wait for another program that looks into the file.
_BUSY_S = 1.0
# A read ends at either limit; the limits of a transaction are `iort_agent.spool.sqlite`'s.
READ_ENTRIES, READ_BYTES = 64, 512 * 1024
_SHRINK_PAGES = 1024
# A database, and the files that SQLite keeps beside it while it is open.
SUFFIXES = ("", "-wal", "-shm")
_LOCK_FLAGS = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC


class QueueLock:
    """Keeps a second agent away from the queue, from when it is made until `close`.

    ``ours`` says whether an agent has had its queue here before. Raises `AgentError` if another agent has
    the queue, `OSError` if the lock's file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        name = Path(f"{path}.lock")
        self._fd = os.open(name, _LOCK_FLAGS, 0o600)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            content = os.pread(self._fd, 32, 0)
            os.close(self._fd)
            if not isinstance(error, BlockingIOError):
                raise
            process = int(content) if content.isdigit() else "unknown"
            raise AgentError(
                f"{name}: the queue is in use by another iort-agent (process {process}): "
                "end that one, or give this robot a queue.path of its own"
            ) from error
        self.ours = os.fstat(self._fd).st_size > 0

    def note_owner(self) -> None:
        """Note this process as the queue's, once the queue's file is known to be one."""
        self.ours = True
        with contextlib.suppress(OSError):  # the lock holds without it, on a full disk too
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, b"%d" % os.getpid(), 0)

    def close(self) -> None:
        """Give the queue to whoever comes next."""
        os.close(self._fd)


class SpoolFile:
    """An open database. Every method may raise `sqlite3.Error`; used by one thread at a time."""

    def __init__(self, path: Path, durability: str) -> None:
        # SQLite gives its log the file's permissions.
        make_private(path)
        for suffix in SUFFIXES[1:]:
            if Path(f"{path}{suffix}").is_symlink():
                raise OSError(f"{path}{suffix} is a link, which is not followed: remove it")
        self.connection = sqlite3.connect(
            str(path), timeout=_BUSY_S, isolation_level=None, check_same_thread=False
        )
        self._path = path
        try:
            self._set_up(durability)
        except BaseException:
            self.abandon()
            raise

    def _set_up(self, durability: str) -> None:
        run = self.connection.execute
        # First, because a file that is refused must stay as it is.
        is_new = self._is_new()
        if is_new:
            # Lets the file shrink again.
            run("PRAGMA auto_vacuum = INCREMENTAL")
        run("PRAGMA journal_mode = WAL")
        # FULL syncs the log with every commit; NORMAL leaves that to the kernel, and the checkpoint.
        run(f"PRAGMA synchronous = {'FULL' if durability == FULL else 'NORMAL'}")
        run(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
        if is_new:
            self.connection.executescript(_SCHEMA)
        self._stat = self._path.stat()

    def _is_new(self) -> bool:
        """Whether it has no tables yet. The file of another program, or of another version with what waits in
        it, must be neither written to nor moved away."""
        owner, version = self._number("application_id"), self._number("user_version")
        empty = self.connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if empty and (owner, version) == (0, 0):
            return True
        if owner != _APPLICATION_ID:
            raise sqlite3.DatabaseError("it is a database of another program")
        if version != _VERSION:
            raise AgentError(
                f"{self._path}: was written by another version of iort-agent (format {version}, this one "
                f"knows {_VERSION}): let that version send what is in it, or move the file away"
            )
        return False

    def in_place(self) -> bool:
        """Whether the file is still the one at its path; SQLite would go on in a removed one."""
        try:
            return os.path.samestat(self._path.stat(), self._stat)
        except OSError:
            return False

    def totals(self) -> tuple[int, Backlog]:
        """The highest id, and what is in the file."""
        counts = "SELECT max(id), count(*), total(samples), total(bytes) FROM batches INDEXED BY sizes"
        last, *kept = self.connection.execute(counts).fetchone()
        return last or 0, Backlog(*map(int, kept))

    def runs(self) -> dict[str, tuple[RunEnd, ...]]:
        """The newest runs that the cloud may not know of, by stream, and the last number of each."""
        found: dict[str, tuple[RunEnd, ...]] = {}
        for stream, boot, seq in self.connection.execute("SELECT * FROM runs ORDER BY rowid"):
            found[stream] = (*found.get(stream, ()), RunEnd(boot, seq))[-MAX_PREVIOUS:]
        return found

    def commit(
        self,
        entries: Iterable[Entry],
        *,
        gone: Collection[int] = (),
        ends: Mapping[str, RunEnd] | None = None,
        told: Collection[tuple[str, str]] = (),
    ) -> None:
        """In one transaction: write ``entries``, delete the batches ``gone``, note the last numbers ``ends``
        by stream, and forget the runs ``told``, by stream and name. It may be repeated, since an error
        does not always mean that nothing was written."""
        if not self.in_place():
            raise sqlite3.DatabaseError("it was removed")
        run, many = self.connection.execute, self.connection.executemany
        run("BEGIN IMMEDIATE")
        try:
            many("DELETE FROM batches WHERE id = ?", [(entry_id,) for entry_id in gone])
            many(
                "INSERT OR REPLACE INTO batches VALUES (?, ?, ?, ?, ?, ?, ?)",
                [(e.id, e.stream, e.seq, e.samples, len(e.payload), _crc(e), e.payload) for e in entries],
            )
            ended = [(stream, end.boot, end.seq) for stream, end in (ends or {}).items()]
            many("INSERT OR REPLACE INTO runs VALUES (?, ?, ?)", ended)
            many("DELETE FROM runs WHERE stream = ? AND boot = ?", list(told))
            run("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):
                if self.connection.in_transaction:
                    run("ROLLBACK")
            raise

    def read(self, after: int, to: int) -> list[Entry]:
        """The batches with an id greater than ``after``, up to ``to``: all of them, or as many as a read
        may have. Raises `sqlite3.DatabaseError` if a batch is not as it was written."""
        rows = "id > ? AND id <= ? ORDER BY id LIMIT ?"
        return read_batches(self.connection, rows, (after, to, READ_ENTRIES))

    def oldest(self, after: int, max_batches: int) -> list[tuple[int, int, int]]:
        """Id, samples and bytes of the oldest batches with an id greater than ``after``."""
        sizes = "SELECT id, samples, bytes FROM batches INDEXED BY sizes WHERE id > ? ORDER BY id LIMIT ?"
        return self.connection.execute(sizes, (after, max_batches)).fetchall()

    def move_ids(self, offset: int) -> None:
        """Add the offset, which is no less than any id, to the ids."""
        self.connection.execute("UPDATE batches SET id = id + ?", (offset,))

    def check_writable(self) -> None:
        """Raises `sqlite3.Error` if the disk does not work, or another program has locked the file."""
        self.connection.execute("BEGIN IMMEDIATE")
        self.connection.execute("ROLLBACK")

    def shrink(self) -> bool:
        """Give some unused pages back to the disk; whether there may be more."""
        if self._number("freelist_count") < _SHRINK_PAGES:
            return False
        # Every page is a step, and only a script takes more than the first.
        self.connection.executescript(f"PRAGMA incremental_vacuum({_SHRINK_PAGES})")
        return True

    def close(self) -> None:
        """Write everything into the one file, and on the disk, and close it."""
        self.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        self.connection.close()

    def abandon(self) -> None:
        """Close it as it is."""
        with contextlib.suppress(sqlite3.Error):
            self.connection.close()

    def _number(self, pragma: str) -> int:
        return int(self.connection.execute(f"PRAGMA {pragma}").fetchone()[0])


def read_batches(db: sqlite3.Connection, where: str, values: tuple[int, ...]) -> list[Entry]:
    """The batches that fulfil a condition, until they reach the size of a read. Raises
    `sqlite3.DatabaseError` if one is not as it was written."""
    entries, size = [], 0
    rows = db.execute(
        f"SELECT id, stream, seq, samples, crc, payload FROM batches WHERE {where}",  # noqa: S608 - conditions of our own
        values,
    )
    try:
        for entry_id, stream, seq, samples, crc, payload in rows:
            entry = Entry(entry_id, stream, seq, payload, samples)
            if type(payload) is not bytes or crc != _crc(entry):
                raise sqlite3.DatabaseError(f"batch {entry_id} is not as it was written")
            entries.append(entry)
            size += len(payload)
            if size >= READ_BYTES:
                break
    finally:
        # A statement left open would keep the log from being emptied.
        rows.close()
    return entries


def _crc(entry: Entry) -> int:
    head = f"{entry.stream} {entry.seq} {entry.samples} "
    return zlib.crc32(entry.payload, zlib.crc32(head.encode()))


_SET_ASIDE_KEPT = 3
_GROUP = 256


def is_damage(error: Exception) -> bool:
    """Whether the file's content is at fault. A disk that is full, read-only or failing raises
    `sqlite3.OperationalError`, and so does a file that another program has locked."""
    return isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError)


class Salvage(NamedTuple):
    """Where a damaged file is now, what was saved, and what is known to be lost."""

    aside: Path | None
    saved: Dropped
    lost: Dropped


def rebuild(
    path: Path,
    damaged: SpoolFile | None,
    gone: Collection[int],
    *,
    connect: Callable[[Path], SpoolFile],
    now_us: int,
) -> Salvage:
    """Put a new file at the path, with what can be read of the damaged one, and set that one aside.

    ``damaged`` is the file if it is open; it may have been removed. The batches ``gone`` are left out.
    """
    new = rebuilt(path)
    _remove(new)
    source = damaged.connection if damaged is not None else sqlite3.connect(str(path))
    fresh = connect(new)
    try:
        saved, lost = _copy(source, fresh, gone)
        fresh.close()
    finally:
        fresh.abandon()
        if damaged is None:
            source.close()
    aside = _set_aside(path, now_us) if path.exists() else None
    put_in_place(path)
    return Salvage(aside, saved, lost)


def rebuilt(path: Path) -> Path:
    """The name of a new file until it is complete. A kill may leave it alone there."""
    return path.with_name(f"{path.name}.new")


def put_in_place(path: Path) -> None:
    """Give the new file its name. The log of a file that was removed must not stay: SQLite would write it
    into the new one."""
    for suffix in SUFFIXES[1:]:
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").unlink()
    rebuilt(path).replace(path)


def _set_aside(path: Path, now_us: int) -> Path:
    """Rename the file, with its log; only the newest few of those set aside are kept."""
    now = dt.datetime.fromtimestamp(now_us / 1_000_000, dt.timezone.utc)
    aside = path.with_name(f"{path.name}.corrupt-{now:%Y%m%dT%H%M%S.%fZ}")
    # The log last: without it the database may lack batches, and a kill would leave it in its place.
    for suffix in SUFFIXES:
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").replace(f"{aside}{suffix}")
    files = [str(file) for file in path.parent.glob(f"{path.name}.corrupt-*")]
    ours = {file[:-4] if file.endswith(SUFFIXES[1:]) else file for file in files}
    for old in sorted(ours)[:-_SET_ASIDE_KEPT]:
        _remove(Path(old))
    return aside


def _remove(path: Path) -> None:
    for suffix in SUFFIXES:
        with contextlib.suppress(OSError):
            Path(f"{path}{suffix}").unlink()


def _copy(source: sqlite3.Connection, into: SpoolFile, gone: Collection[int]) -> tuple[Dropped, Dropped]:
    """Copy what is still good; what was saved, and what is known to be lost."""
    with contextlib.suppress(sqlite3.Error):
        for stream, boot, seq in source.execute("SELECT stream, boot, last_seq FROM runs ORDER BY rowid"):
            into.commit([], ends={stream: RunEnd(boot, seq)})
    saved, lost = [], []
    group: list[Entry] = []
    for entry_id, samples in sorted(_known(source).items()):
        if entry_id in gone:
            continue
        try:
            (entry,) = read_batches(source, "id = ?", (entry_id,))
        except (sqlite3.Error, ValueError):
            lost.append(samples)
            continue
        saved.append(samples)
        group.append(entry)
        if len(group) >= _GROUP:
            into.commit(group)
            group = []
    into.commit(group)
    return Dropped(len(saved), sum(saved)), Dropped(len(lost), sum(lost))


def _known(db: sqlite3.Connection) -> dict[int, int]:
    """The ids that either the table or its index still knows, and the samples."""
    known: dict[int, int] = {}
    for source in ("batches NOT INDEXED", "batches INDEXED BY sizes"):
        for order in ("ASC", "DESC"):
            with contextlib.suppress(sqlite3.Error):
                known.update(db.execute(f"SELECT id, samples FROM {source} ORDER BY id {order}"))  # noqa: S608 - names of our own
    return {i: n for i, n in known.items() if type(i) is int and type(n) is int}
