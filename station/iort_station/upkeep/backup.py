"""A backup of the kept cloud: one tar archive with the files of its state folder, and last their hashes."""

from __future__ import annotations

import fcntl
import glob
import gzip
import hashlib
import io
import json
import lzma
import os
import shutil
import sqlite3
import tarfile
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any

from iort_station.errors import StationError
from iort_station.output import whole
from iort_station.upkeep.snapshot import LAST_BACKUP, VERSION, Progress, Snapshot, held, is_database, snapshot

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


# Restores a backup of the kept cloud, after all of it was read and compared with its hashes.

_CHUNK = 1024 * 1024
# How many problems an error names.
_NAMED = 3


def verify(archive: Path, progress: Progress = lambda _bytes: None) -> Manifest:
    """Read the whole archive and compare it with its hashes. Raises `StationError`."""
    return _read(archive, None, progress)


def restore(
    archive: Path, folder: Path, *, force: bool = False, progress: Progress = lambda _bytes: None
) -> tuple[Manifest, Path | None]:
    """Make the state folder from the archive, whole or not at all. Raises `StationError`.

    With ``force``, a state that is there already is renamed; returns its new path, too.
    """
    there = folder.exists() and any(folder.iterdir())
    if there and not force:
        raise StationError(
            f"{folder} has a cloud's state: give another --state, or --force, which renames it"
        )
    with held(folder), _beside_restore(folder) as made:
        manifest = _read(archive, made, progress)
        for path in made.iterdir():
            if path.is_file() and is_database(path):
                _check_database(path)
        os.sync()
        kept = folder.with_name(f"{folder.name}.until-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}")
        if there:
            folder.rename(kept)
        elif folder.exists():
            folder.rmdir()
        made.rename(folder)
    return manifest, kept if there else None


@contextmanager
def _beside_restore(folder: Path) -> Iterator[Path]:
    """A new folder on the same disk, which is removed unless it is renamed."""
    made = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(mode=0o700, parents=True)
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _read(archive: Path, target: Path | None, progress: Progress) -> Manifest:
    """Read every member, into the target if there is one."""
    found: dict[str, Entry] = {}
    text = b""
    try:
        with tarfile.open(archive, "r|*") as tar:
            for member in tar:
                file = tar.extractfile(member)
                if file is None or not _is_inside(member.name):
                    raise StationError(
                        f"{archive} must be a backup of `iort backup`, got the member {member.name!r}"
                    )
                with file:
                    if member.name == MANIFEST:
                        text = file.read()
                        continue
                    found[member.name] = _take(file, member, target, progress)
    except (tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, gzip.BadGzipFile) as error:
        raise StationError(f"{archive} is damaged, or no backup of `iort backup`: {error}") from error
    manifest = _manifest(archive, text)
    wrong = [name for name in {**found, **manifest.files} if found.get(name) != manifest.files.get(name)]
    if wrong:
        named = ", ".join(sorted(wrong)[:_NAMED])
        raise StationError(
            f"{archive} is damaged: {len(wrong)} files are not as they were saved, such as {named}"
        )
    return manifest


def _is_inside(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and path.as_posix() == name


def _take(file: IO[bytes], member: tarfile.TarInfo, target: Path | None, progress: Progress) -> Entry:
    hashing = Hashing(file, progress)
    if target is None:
        while hashing.read(_CHUNK):
            pass
    else:
        path = target / member.name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, member.mode & 0o700), "wb") as out:
            shutil.copyfileobj(hashing, out, _CHUNK)
    return Entry(hashing.size, hashing.sha256, member.mode)


def _manifest(archive: Path, text: bytes) -> Manifest:
    if not text:
        raise StationError(f"{archive} is not whole: its list of hashes is missing")
    try:
        said: dict[str, Any] = json.loads(text)
        if said["format"] != FORMAT:
            raise StationError(
                f"{archive} must have format {FORMAT}, got {said['format']}: use the release that made it"
            )
        files = {name: Entry(**entry) for name, entry in said.pop("files").items()}
        manifest = Manifest(**said, files=files)
    except (KeyError, TypeError, ValueError) as error:
        raise StationError(f"{archive}: its list of hashes is damaged: {error}") from error
    return manifest


def _check_database(path: Path) -> None:
    try:
        with closing(sqlite3.connect(path)) as connection:
            (said,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.Error as error:
        said = str(error)
    if said != "ok":
        raise StationError(f"the backup's database {path.name} is damaged: {said}")
