"""Restores a backup of the kept cloud, after all of it was read and compared with its hashes."""

from __future__ import annotations

import gzip
import json
import lzma
import os
import shutil
import sqlite3
import tarfile
import time
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any

from iort_station.errors import StationError
from iort_station.upkeep.backup import FORMAT, MANIFEST, Entry, Hashing, Manifest
from iort_station.upkeep.snapshot import Progress, is_database
from iort_station.upkeep.state import held

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
    with held(folder), _beside(folder) as made:
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
def _beside(folder: Path) -> Iterator[Path]:
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
