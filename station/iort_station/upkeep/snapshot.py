"""The state of a kept cloud at one moment, while it goes on: what a `kill -9` at that moment would leave.

The ledger is a read transaction. Every other file is a hard link: the cloud replaces files and never changes
them, so a link keeps what it was. The state has files and ledger of the same moment if no file was replaced
between the links that were made before the transaction began, and those made after."""

from __future__ import annotations

import fcntl
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

from iort_station import kept
from iort_station.errors import StationError

# The state folder of a kept cloud, for those who copy or replace it.

VERSION, LAST_BACKUP = "VERSION", "last-backup.json"
# A start makes these anew, so no backup has them: addresses, logs, files in use. A robot's
# files below s3/ may have such names, too.
MADE_ANEW = (kept.UP, kept.CLOUD, LAST_BACKUP, "tmp", "*.log", "*.log.*", "*.sock", "*-wal", "*-shm")
# A file that is being written, in any folder.
UNFINISHED = ".tmp"


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the state folder, as a running cloud does. Raises `StationError` if another process holds it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with kept.lock_of(folder).open("a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.seek(0)
            raise StationError(
                f"a cloud runs in {folder} (process {lock.read().strip()}): stop it first, with `make down`"
            ) from error
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        yield


_FOLDER = ".backup"
_ATTEMPTS = 20
_SQLITE = b"SQLite format 3\x00"
_PAGES = 1024

# Takes the bytes that were copied since the last call.
Progress = Callable[[int], object]


class Snapshot(NamedTuple):
    """Files by their names in the state folder, and the open databases."""

    files: dict[str, Path]
    databases: dict[str, sqlite3.Connection]

    def size(self) -> int:
        sizes = (_pragma(one, "page_count") * _pragma(one, "page_size") for one in self.databases.values())
        return sum(path.stat().st_size for path in self.files.values()) + sum(sizes)

    def copy_database(self, name: str, target: Path, progress: Progress) -> None:
        """Copy a database as it was at the snapshot's moment, by SQLite's backup API."""
        source = self.databases[name]
        page_bytes, left = _pragma(source, "page_size"), _pragma(source, "page_count")

        def tell(_status: int, remaining: int, _total: int) -> None:
            nonlocal left
            progress((left - remaining) * page_bytes)
            left = remaining

        copy = sqlite3.connect(target)
        try:
            source.backup(copy, pages=_PAGES, progress=tell)
        finally:
            copy.close()


@contextmanager
def snapshot(folder: Path) -> Iterator[Snapshot]:
    """The state folder's snapshot, until the end of the block. Raises `StationError`."""
    with _links(folder) as links:
        links.make()
        for _ in range(_ATTEMPTS):
            databases = {name: _opened(folder / name) for name in links.databases}
            try:
                if not links.make():
                    yield Snapshot({name: links.folder / name for name in links.inodes}, databases)
                    return
            finally:
                for one in databases.values():
                    one.close()
    raise StationError(f"the files of {folder} are replaced all the time: try again when it has less to do")


class _Links:
    """Hard links of the files of a folder."""

    def __init__(self, source: Path, folder: Path) -> None:
        self._source, self.folder = source, folder
        self.inodes: dict[str, int] = {}
        self.databases: set[str] = set()

    def make(self) -> bool:
        """Link every file; whether one was replaced since the last call. One that was deleted keeps its
        link."""
        replaced = False
        for name, inode in _files(self._source):
            known = self.inodes.get(name)
            if known == inode or name in self.databases:
                continue
            # It may have been deleted meanwhile.
            with suppress(FileNotFoundError):
                # A robot's file may be a database, too: it is copied byte by byte.
                if "/" not in name and is_database(self._source / name):
                    self.databases.add(name)
                    continue
                _link(self._source / name, self.folder / name)
                self.inodes[name] = inode
                replaced = replaced or known is not None
        return replaced


def _files(folder: Path, prefix: str = "") -> Iterator[tuple[str, int]]:
    """The files that a backup has: their paths in the folder, and their inodes."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(UNFINISHED) or (not prefix and _made_anew(entry.name)):
                continue
            if entry.is_dir(follow_symlinks=False):
                with suppress(FileNotFoundError):
                    yield from _files(Path(entry.path), f"{prefix}{entry.name}/")
            elif entry.is_file(follow_symlinks=False):
                yield f"{prefix}{entry.name}", entry.inode()


def _made_anew(name: str) -> bool:
    return name == _FOLDER or any(fnmatch(name, pattern) for pattern in MADE_ANEW)


def is_database(path: Path) -> bool:
    """Whether the file is SQLite's."""
    with path.open("rb") as file:
        return file.read(len(_SQLITE)) == _SQLITE


def _opened(path: Path) -> sqlite3.Connection:
    """A database in a read transaction, which the backup API then uses."""
    connection = sqlite3.connect(path, isolation_level=None, timeout=60.0)
    connection.execute("BEGIN")
    connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    return connection


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])


@contextmanager
def _links(folder: Path) -> Iterator[_Links]:
    """An empty folder for links, which only this process uses."""
    links = folder / _FOLDER
    links.mkdir(mode=0o700, exist_ok=True)
    descriptor = os.open(links, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StationError(f"another backup of {folder} is being made") from error
        # A backup that was killed has left its links.
        for old in links.iterdir():
            shutil.rmtree(old) if old.is_dir() else old.unlink()
        try:
            yield _Links(folder, links)
        finally:
            shutil.rmtree(links, ignore_errors=True)
    finally:
        os.close(descriptor)


def _link(file: Path, link: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    try:
        os.link(file, link)
    except FileNotFoundError:
        raise
    except OSError:
        # This file system has no hard links, or the file is another user's.
        shutil.copy2(file, link)
