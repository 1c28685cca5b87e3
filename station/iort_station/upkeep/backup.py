"""A backup of the kept cloud: one tar archive with the files of its state folder, and last their hashes."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import io
import json
import os
import shutil
import tarfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, TYPE_CHECKING

from iort_station.errors import StationError
from iort_station.output import whole
from iort_station.upkeep.snapshot import Progress, Snapshot, snapshot
from iort_station.upkeep.state import LAST_BACKUP, VERSION

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

MANIFEST, FORMAT = "manifest.json", 1
# Free space that a backup leaves on its disk. The cloud's own data may be on the same one.
_LEFT_BYTES = 1_000_000_000


@dataclass(frozen=True)
class Entry:
    """A file of the archive."""

    size: int
    sha256: str
    mode: int


@dataclass(frozen=True)
class Manifest:
    """The last member of the archive: without it, the archive is not whole."""

    format: int
    # Of the release that made it, and of the state's layout.
    release: str
    state_version: str
    made_s: float
    files: dict[str, Entry]

    @property
    def size(self) -> int:
        return sum(entry.size for entry in self.files.values())


class Hashing(io.RawIOBase):
    """Reads a file, and hashes what was read."""

    def __init__(self, file: IO[bytes], progress: Progress) -> None:
        self._file, self._progress = file, progress
        self.size, self._hash = 0, hashlib.sha256()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: ReadableBuffer, /) -> int:
        view = memoryview(buffer)
        data = self._file.read(len(view))
        view[: len(data)] = data
        self.size += len(data)
        self._hash.update(data)
        self._progress(len(data))
        return len(data)

    @property
    def sha256(self) -> str:
        """Of all that was read so far."""
        return self._hash.hexdigest()


def back_up(
    folder: Path, out: Path, *, force: bool = False, progress: Progress = lambda _bytes: None
) -> Manifest:
    """Write the archive, also while the cloud runs. Only its owner may read it: it has the cloud's keys.

    ``progress`` is called with twice the bytes of databases, which are copied first. Raises `StationError`.
    """
    if not (folder / VERSION).is_file():
        raise StationError(f"{folder} has no kept cloud: `make up` makes one, --state names another folder")
    if out.exists() and not force:
        raise StationError(f"{out} exists: name another file, or overwrite it with --force")
    made_s = time.time()
    _remove_left(out)
    with (
        whole(out, force=True) as part,
        os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as archive,
        _locked(archive),
        _copied(folder, part, progress) as files,
    ):
        manifest = _write(archive, files, made_s, progress)
        archive.flush()
        os.fsync(archive.fileno())
    told = {"made_s": made_s, "file": str(out.resolve()), "bytes": out.stat().st_size}
    with whole(folder / LAST_BACKUP, force=True) as part:
        part.write_text(json.dumps(told) + "\n")
    return manifest


def size_of(folder: Path) -> int:
    """About the bytes that `back_up` tells in all."""
    with snapshot(folder) as found:
        return found.size() + _database_bytes(found)


@contextmanager
def _locked(archive: IO[bytes]) -> Iterator[None]:
    """Hold a part's lock, so that nobody takes it for one that was left; where there are no locks, do not."""
    with suppress(OSError):
        fcntl.flock(archive, fcntl.LOCK_EX | fcntl.LOCK_NB)
    yield


def _remove_left(out: Path) -> None:
    """Remove what a backup to the same file has left that was killed."""
    for part in out.parent.glob(f".{glob.escape(out.name)}.*.part"):
        # Another backup may be writing it.
        with suppress(OSError), part.open("rb") as left:
            fcntl.flock(left, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(_beside(part), ignore_errors=True)
            part.unlink()


def _beside(part: Path) -> Path:
    """The folder for copies of databases."""
    return part.with_suffix(".copies")


@contextmanager
def _copied(folder: Path, part: Path, progress: Progress) -> Iterator[dict[str, Path]]:
    """The files of the archive; of databases, copies beside the archive."""
    with snapshot(folder) as found, ExitStack() as stack:
        needed = found.size() + _database_bytes(found) + _LEFT_BYTES
        free = shutil.disk_usage(part.parent).free
        if free < needed:
            raise StationError(
                f"{part.parent} must have {needed / 1e9:.1f} GB free for this, got {free / 1e9:.1f} GB: "
                "write the backup to another disk"
            )
        beside = _beside(part)
        beside.mkdir(mode=0o700)
        stack.callback(shutil.rmtree, beside, ignore_errors=True)
        files = dict(found.files)
        for number, name in enumerate(found.databases):
            files[name] = beside / str(number)
            found.copy_database(name, files[name], progress)
        # The databases are copied, so the cloud may shorten its write-ahead log again.
        for database in found.databases.values():
            database.close()
        yield files


def _database_bytes(found: Snapshot) -> int:
    return found.size() - sum(path.stat().st_size for path in found.files.values())


def _write(archive: IO[bytes], files: dict[str, Path], made_s: float, progress: Progress) -> Manifest:
    entries = {}
    with tarfile.open(fileobj=archive, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, path in sorted(files.items()):
            with path.open("rb") as file:
                info = tarfile.TarInfo(name)
                status = os.fstat(file.fileno())
                info.size, info.mode, info.mtime = (
                    status.st_size,
                    status.st_mode & 0o700,
                    int(status.st_mtime),
                )
                hashing = Hashing(file, progress)
                tar.addfile(info, hashing)
                entries[name] = Entry(hashing.size, hashing.sha256, info.mode)
        state_version = files[VERSION].read_text().strip()
        manifest = Manifest(FORMAT, version("iort-station"), state_version, made_s, entries)
        text = json.dumps(asdict(manifest), indent=1).encode()
        info = tarfile.TarInfo(MANIFEST)
        info.size, info.mode, info.mtime = len(text), 0o600, int(made_s)
        tar.addfile(info, io.BytesIO(text))
    return manifest
