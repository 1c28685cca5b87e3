"""The spool's SQLite file: what is in it, and what is done when it is damaged."""

from __future__ import annotations

import contextlib
import datetime as dt
import sqlite3
import zlib
from pathlib import Path
from typing import Collection, Iterable, Mapping, NamedTuple

from iort_agent.common.private_files import make_private
from iort_agent.errors import AgentError
from iort_agent.spool.memory import FULL, Dropped, Entry

_APPLICATION_ID = 0x696F7274  # "iort"
_VERSION = 1
# The index has what the ledger is made of, so that a start need not read the payloads.
_SCHEMA = """
BEGIN;
CREATE TABLE batches (
    id INTEGER PRIMARY KEY, stream TEXT NOT NULL, seq INTEGER NOT NULL, samples INTEGER NOT NULL,
    bytes INTEGER NOT NULL, crc INTEGER NOT NULL, payload BLOB NOT NULL
);
CREATE INDEX ledger ON batches (id, bytes, samples);
CREATE TABLE streams (stream TEXT PRIMARY KEY, next_seq INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE dropped (id INTEGER PRIMARY KEY, batches INTEGER NOT NULL, samples INTEGER NOT NULL);
PRAGMA application_id = %d;
PRAGMA user_version = %d;
COMMIT;
""" % (_APPLICATION_ID, _VERSION)  # noqa: UP031 - braces would be doubled in nothing, but SQL reads plain
# The write-ahead log is cut to this after a checkpoint, which comes every 1,000 pages.
_LOG_BYTES = 4 * 1024 * 1024
# So long is somebody waited for who looks into the file with another program.
_BUSY_S = 1.0
_SHRINK_PAGES = 1024
_SET_ASIDE_KEPT = 3
_SALVAGE_GROUP = 256
_SUFFIXES = ("", "-wal", "-shm")


class ForeignFileError(sqlite3.DatabaseError):
    """The file does not look like ours."""


class Content(NamedTuple):
    """What is in the file, without the payloads: id, bytes and samples of each batch."""

    batches: list[tuple[int, int, int]]
    seqs: dict[str, int]
    dropped: Dropped


class SpoolFile:
    """An open database. Every method may raise `sqlite3.Error`; used by one thread at a time."""

    def __init__(self, path: Path, *, durability: str, max_file_bytes: int | None = None) -> None:
        # SQLite gives its log the file's permissions.
        make_private(path)
        for suffix in _SUFFIXES[1:]:
            if Path(f"{path}{suffix}").is_symlink():
                raise OSError(f"{path}{suffix} is a link, which is not followed: remove it")
        self._db = sqlite3.connect(str(path), timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        self._path = path
        try:
            self._set_up(path, durability, max_file_bytes)
        except BaseException:
            self.abandon()
            raise

    def _set_up(self, path: Path, durability: str, max_file_bytes: int | None) -> None:
        run = self._db.execute
        # Takes effect in a new file only, and lets the file shrink again.
        run("PRAGMA auto_vacuum = INCREMENTAL")
        self._check_owner(path)
        run("PRAGMA journal_mode = WAL")
        # FULL syncs the log with every commit; NORMAL leaves that to the kernel, and the checkpoint.
        run(f"PRAGMA synchronous = {'FULL' if durability == FULL else 'NORMAL'}")
        run(f"PRAGMA journal_size_limit = {_LOG_BYTES}")
        if max_file_bytes is not None:
            run(f"PRAGMA max_page_count = {max_file_bytes // self._number('page_size')}")
        if not self._number("user_version"):
            self._db.executescript(_SCHEMA)
        self._inode = path.stat().st_ino

    def _check_owner(self, path: Path) -> None:
        """Refuse the file of another program: it must be neither written to nor moved away."""
        owner, version = self._number("application_id"), self._number("user_version")
        empty = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if empty and (owner, version) == (0, 0):
            return
        if owner != _APPLICATION_ID:
            raise ForeignFileError("it is a database of another program")
        if version != _VERSION:
            raise AgentError(
                f"{path}: was written by another version of iort-agent (format {version}, this one knows "
                f"{_VERSION}): let that version send what is in it, or move the file away"
            )

    @property
    def connection(self) -> sqlite3.Connection:
        """The connection, to read from."""
        return self._db

    def in_place(self) -> bool:
        """Whether the file is still the one at its path; SQLite would go on in a removed one."""
        try:
            return self._path.stat().st_ino == self._inode
        except OSError:
            return False

    def check(self) -> None:
        """Read all of it; raises `sqlite3.DatabaseError` where it is damaged."""
        (answer,) = self._db.execute("PRAGMA quick_check(1)").fetchone()
        if answer != "ok":
            raise sqlite3.DatabaseError(answer)

    def load(self) -> Content:
        """What is in the file."""
        batches = self._db.execute("SELECT id, bytes, samples FROM batches INDEXED BY ledger ORDER BY id")
        seqs = dict(self._db.execute("SELECT stream, next_seq FROM streams"))
        dropped = self._db.execute("SELECT batches, samples FROM dropped").fetchone()
        return Content(batches.fetchall(), seqs, Dropped(*(dropped or (0, 0))))

    def commit(
        self,
        entries: Iterable[Entry],
        *,
        gone: Collection[int] = (),
        seqs: Mapping[str, int] | None = None,
        dropped: Dropped | None = None,
    ) -> None:
        """Write and delete batches, and note the streams' next numbers, in one transaction. Doing it
        again does no harm: an error does not always mean that nothing was written."""
        if not self.in_place():
            raise sqlite3.DatabaseError("it was removed")
        run, many = self._db.execute, self._db.executemany
        run("BEGIN IMMEDIATE")
        try:
            many("DELETE FROM batches WHERE id = ?", [(entry_id,) for entry_id in gone])
            many(
                "INSERT OR REPLACE INTO batches VALUES (?, ?, ?, ?, ?, ?, ?)",
                [(e.id, e.stream, e.seq, e.samples, len(e.payload), _crc(e), e.payload) for e in entries],
            )
            many("INSERT OR REPLACE INTO streams VALUES (?, ?)", list((seqs or {}).items()))
            if dropped is not None:
                run("INSERT OR REPLACE INTO dropped VALUES (0, ?, ?)", dropped)
            run("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):
                if self._db.in_transaction:
                    run("ROLLBACK")
            raise

    def read(self, first: int, max_bytes: int) -> list[Entry]:
        """The batches from that id on, at least one if there is one, until they reach so many bytes.

        Raises `sqlite3.DatabaseError` where a batch is not as it was written.
        """
        return _read(self._db, "id >= ?", first, max_bytes)

    def move_ids(self, offset: int) -> None:
        """Add the offset, which is no less than any id, to the ids."""
        self._db.execute("UPDATE batches SET id = id + ?", (offset,))

    def shrink(self) -> bool:
        """Give some unused pages back to the disk; whether there may be more."""
        if self._number("freelist_count") < _SHRINK_PAGES:
            return False
        # Every page is a step, of which only a script takes more than the first.
        self._db.executescript(f"PRAGMA incremental_vacuum({_SHRINK_PAGES})")
        return True

    def close(self) -> None:
        """Write everything into the one file, and on the disk, and close it."""
        self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        self._db.close()

    def abandon(self) -> None:
        """Close it as it is."""
        with contextlib.suppress(sqlite3.Error):
            self._db.close()

    def _number(self, pragma: str) -> int:
        return int(self._db.execute(f"PRAGMA {pragma}").fetchone()[0])


def is_damage(error: Exception) -> bool:
    """Whether the file's content is at fault. A disk that is full, read-only or failing raises
    `sqlite3.OperationalError`, and so does a file locked by another program."""
    return isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError)


def set_aside(path: Path, now_us: int) -> Path:
    """Rename the file, with its log; only the newest few of those set aside are kept."""
    now = dt.datetime.fromtimestamp(now_us / 1_000_000, dt.timezone.utc)
    aside = path.with_name(f"{path.name}.corrupt-{now:%Y%m%dT%H%M%S.%fZ}")
    # The log first: alone, the database is still one, while the new one must not find this log.
    for suffix in reversed(_SUFFIXES):
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").replace(f"{aside}{suffix}")
    files = [str(file) for file in path.parent.glob(f"{path.name}.corrupt-*")]
    ours = {file[:-4] if file.endswith(_SUFFIXES[1:]) else file for file in files}
    for old in sorted(ours)[:-_SET_ASIDE_KEPT]:
        remove(Path(old))
    return aside


def remove(path: Path) -> None:
    """Remove a file, with its log, if it is there."""
    for suffix in _SUFFIXES:
        with contextlib.suppress(OSError):
            Path(f"{path}{suffix}").unlink()


class Salvage(NamedTuple):
    """What has become of a damaged file's batches, as far as they are known: ids and samples."""

    saved: dict[int, int]
    lost: dict[int, int]


def salvage(aside: Path | SpoolFile, into: SpoolFile, ids: Iterable[int] | None = None) -> Salvage:
    """Copy what is still good in a damaged file, or one still open: of those ids, or of all."""
    saved: dict[int, int] = {}
    try:
        db = aside.connection if isinstance(aside, SpoolFile) else sqlite3.connect(str(aside))
    except sqlite3.Error:
        return Salvage({}, {})
    try:
        known = _known(db) if ids is None else dict.fromkeys(ids, 0)
        group: list[Entry] = []
        for entry_id in sorted(known):
            with contextlib.suppress(sqlite3.Error):
                group += _read(db, "id = ?", entry_id)
            if len(group) >= _SALVAGE_GROUP:
                into.commit(group)
                saved.update((entry.id, entry.samples) for entry in group)
                group = []
        into.commit(group)
        saved.update((entry.id, entry.samples) for entry in group)
    finally:
        with contextlib.suppress(sqlite3.Error):
            db.close()
    return Salvage(saved, {entry_id: n for entry_id, n in known.items() if entry_id not in saved})


def _known(db: sqlite3.Connection) -> dict[int, int]:
    """The ids that either the table or its index still knows, and the samples."""
    known: dict[int, int] = {}
    for source in ("batches NOT INDEXED", "batches INDEXED BY ledger"):
        for order in ("ASC", "DESC"):
            with contextlib.suppress(sqlite3.Error):
                known.update(db.execute(f"SELECT id, samples FROM {source} ORDER BY id {order}"))  # noqa: S608 - names of our own
    return {i: n for i, n in known.items() if type(i) is int and type(n) is int}


def _read(db: sqlite3.Connection, where: str, first: int, max_bytes: int | None = None) -> list[Entry]:
    entries, total = [], 0
    rows = db.execute(
        f"SELECT id, stream, seq, samples, crc, payload FROM batches WHERE {where} ORDER BY id",  # noqa: S608 - conditions of our own
        (first,),
    )
    try:
        for entry_id, stream, seq, samples, crc, payload in rows:
            entry = Entry(entry_id, stream, seq, payload, samples)
            if type(payload) is not bytes or crc != _crc(entry):
                raise sqlite3.DatabaseError(f"batch {entry_id} is not as it was written")
            entries.append(entry)
            total += len(payload)
            if max_bytes is not None and total >= max_bytes:
                break
    finally:
        # A statement left open would keep the log from being emptied.
        rows.close()
    return entries


def _crc(entry: Entry) -> int:
    head = f"{entry.stream} {entry.seq} {entry.samples} "
    return zlib.crc32(entry.payload, zlib.crc32(head.encode()))
