"""The ledger: one SQLite file with the embedded cloud's state, and commits that many callers share."""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from iort_station.kept import FLOOR_BYTES
from local.processes import LocalError

Sync = Literal["off", "normal", "full"]
Row = tuple[Any, ...]

VERSION = 1
_log = logging.getLogger(__name__)
# The write-ahead log is copied into the file from this size on.
_WAL_BYTES = 4 * 1024 * 1024
_LOOK_S = 1.0


class LedgerError(LocalError):
    """The ledger could not be written. All changes that were not committed are undone."""


def settle(path: Path) -> None:
    """Take the write-ahead log into the file, which is whole by itself then: a copy of it, and damage to it,
    shows. Its process must have ended."""
    # Not on a full disk, nor while a backup reads: the log stays, and the next start goes on from it.
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True)) as last:
        # Whoever closes it last takes the log in.
        last.execute("PRAGMA user_version").fetchone()


class Ledger:
    """The ledger's file. All threads may use it.

    Changes gather in one transaction until somebody calls `commit`. With ``sync="full"`` that waits for the
    disk, so that it survives a power cut; with "normal" it survives the end of every process, and "off" is
    for a file that nobody opens again.

    ``floor_bytes`` of the disk stay free of the record lane (`check_room`).
    """

    def __init__(self, path: Path, *, sync: Sync = "off", floor_bytes: int = FLOOR_BYTES) -> None:
        self.path, self.sync, self.floor_bytes = path, sync, floor_bytes
        # How often changes were undone: whoever wrote before must not acknowledge.
        self.undone = 0
        # Called, with the lock held, when changes were undone: what is remembered of them must be forgotten.
        # They may read, and not write.
        self.on_undo: list[Callable[[], object]] = []
        # Called when the disk has failed: what it has is unknown then, so that only a new start may go on.
        self.on_broken: Callable[[LedgerError], object] = lambda _error: None
        self._lock = threading.RLock()
        self._writing = False
        # SQLite calls a transaction over when its commit begins, which may fail.
        self._changed = False
        self._connection = self._open()
        if sync == "full":
            self._write_again()
        self._reading = threading.Lock()
        self._reader = self._open()
        self._committed = 0
        self._disk_lock = threading.Lock()
        self._on_disk = 0
        self._broken: OSError | None = None
        self._room_s = 0.0
        self._closed = threading.Event()
        self._wal = os.open(f"{path}-wal", os.O_RDONLY)
        if sync == "full":
            folder = os.open(path.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)
        self._copying = threading.Thread(target=self._copy_wal, name="ledger", daemon=True)
        self._copying.start()

    def _open(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
        try:
            self._prepare(connection)
        except sqlite3.Error as error:
            connection.close()
            raise LedgerError(f"cannot open {self.path}: {error}") from error
        except LedgerError:
            connection.close()
            raise
        return connection

    def _prepare(self, connection: sqlite3.Connection) -> None:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version > VERSION:
            raise LedgerError(f"{self.path} must have version {VERSION} at most, got {version}: upgrade iort")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA synchronous = {self._synchronous}")
        # Copying waits for the disk: a thread does it.
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        # This makes the write-ahead log's file, too.
        connection.execute(f"PRAGMA user_version = {VERSION}")

    @property
    def _synchronous(self) -> str:
        # "full" is done by `commit`, outside the lock.
        return "OFF" if self.sync == "off" else "NORMAL"

    def define(self, schema: str) -> None:
        """Create tables and indexes, each with ``IF NOT EXISTS``."""
        with self.write() as connection:
            for statement in filter(str.strip, schema.split(";")):
                connection.execute(statement)
        self.commit()

    @contextmanager
    def write(self) -> Iterator[sqlite3.Connection]:
        """Change several rows together: no commit comes between them, and an exception undoes them all.

        Within itself it gives the same connection. Raises `LedgerError` if SQLite fails.
        """
        with self._lock:
            if self._writing:
                yield self._connection
                return
            self._writing = True
            try:
                if not self._connection.in_transaction:
                    self._connection.execute("BEGIN")
                self._changed = True
                self._connection.execute("SAVEPOINT call")
                yield self._connection
                self._connection.execute("RELEASE call")
            except sqlite3.Error as error:
                raise self._undo(error) from error
            except BaseException:
                self._connection.execute("ROLLBACK TO call")
                self._connection.execute("RELEASE call")
                self._forget()
                raise
            finally:
                self._writing = False

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Read row by row, while nobody writes."""
        with self._lock:
            yield self._connection

    def read(self, sql: str, arguments: Sequence[Any] = ()) -> list[Row]:
        """Read rows, also those that nobody has committed yet."""
        with self._lock:
            return self._connection.execute(sql, arguments).fetchall()

    def read_committed(self, sql: str, arguments: Sequence[Any] = ()) -> list[Row]:
        """Commit, and read rows: none of them can be undone. Others go on writing."""
        with self._lock:
            self._commit()
        with self._reading:
            return self._reader.execute(sql, arguments).fetchall()

    @property
    def pending(self) -> bool:
        """Whether `commit` has anything to do."""
        return self._changed or (self.sync == "full" and self._on_disk < self._committed)

    def commit(self, since: int | None = None) -> None:
        """Commit all changes of all callers; one call of several at a time does it for all of them.

        Raises `LedgerError` if that fails, or if changes were undone after ``undone`` was ``since``.
        """
        with self._lock:
            self._commit()
        if self.sync == "full":
            self._wait_for_disk()
        if since is not None and since != self.undone:
            raise LedgerError(f"changes in {self.path} were undone: try again")

    def _commit(self) -> None:
        if self._writing:
            raise RuntimeError("nobody may commit in the middle of a change")
        if self._connection.in_transaction:
            try:
                self._connection.execute("COMMIT")
            except sqlite3.Error as error:
                raise self._undo(error) from error
            self._committed += 1
        self._changed = False

    def _wait_for_disk(self) -> None:
        wanted = self._committed
        with self._disk_lock:
            if self._on_disk >= wanted:
                return
            reached = self._committed
            try:
                if self._broken is None:
                    os.fdatasync(self._wal)
            except OSError as error:
                # The system may have dropped what it could not write, and says so once.
                self._broken = error
            if self._broken is not None:
                broken = LedgerError(f"the disk of {self.path} fails: {self._broken}; start again")
                self.on_broken(broken)
                raise broken
            self._on_disk = reached

    def _write_again(self) -> None:
        """Empty the write-ahead log into the file. After a disk has failed, the log may be whole in memory
        and have a hole on the disk, and what follows a hole is lost at a power cut."""
        try:
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        except sqlite3.Error as error:
            self._connection.close()
            raise LedgerError(f"cannot write {self.path}: {error}") from error

    def _undo(self, error: sqlite3.Error) -> LedgerError:
        """Undo everything that is not committed. SQLite may have done so already."""
        _log.error("changes in %s are undone: %s", self.path, error)
        with suppress(sqlite3.Error):
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
        self.undone += 1
        self._changed = False
        self._forget()
        return LedgerError(f"cannot write {self.path}: {error}")

    def _forget(self) -> None:
        for forget in self.on_undo:
            forget()

    def check_room(self) -> None:
        """Raise `LedgerError` if less than ``floor_bytes`` of the disk are free."""
        now_s = time.monotonic()
        if now_s < self._room_s + _LOOK_S:
            return
        disk = os.statvfs(self.path.parent)
        free = disk.f_bavail * disk.f_frsize
        if free < self.floor_bytes:
            raise LedgerError(
                f"the disk of {self.path} must have {self.floor_bytes >> 20} MB free, got {free >> 20} MB"
            )
        self._room_s = now_s

    def _copy_wal(self) -> None:
        """Copy the write-ahead log into the file when it is large, so that SQLite begins it anew."""
        # It waits for no reader: it comes again.
        own = sqlite3.connect(self.path, isolation_level=None, timeout=0)
        own.execute(f"PRAGMA synchronous = {self._synchronous}")
        while not self._closed.wait(_LOOK_S):
            try:
                if os.fstat(self._wal).st_size > _WAL_BYTES:
                    self._checkpoint(own)
            except (sqlite3.Error, LedgerError, OSError) as error:  # noqa: PERF203 - the thread goes on
                # A full disk: the log keeps what it has, and its next growth is refused.
                _log.warning("%s cannot take its log: %s", self.path, error)
        own.close()

    def _checkpoint(self, own: sqlite3.Connection) -> None:
        # Most of it while others write; the rest, which is little, while nobody does.
        own.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        with self._lock:
            self._commit()
            own.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()

    def close(self) -> None:
        """Commit, and close the file."""
        self._closed.set()
        self._copying.join()
        try:
            self.commit()
        finally:
            with self._lock, self._reading:
                self._connection.close()
                self._reader.close()
            os.close(self._wal)
