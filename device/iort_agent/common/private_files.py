"""Reads and writes files in folders that other users may write into.

No link below ``root`` is followed. A written file gets its name when it is complete, and only its owner may
read it. ``root`` is trusted, because the configuration names it; ``name`` is the path below it.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from pathlib import Path, PurePath
from typing import BinaryIO, Iterator

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
# O_NONBLOCK: opening a pipe that somebody put there must not wait for a writer.
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE, _FOLDER_MODE = 0o600, 0o700


@contextlib.contextmanager
def folder_of(root: Path, name: PurePath, *, make: bool = False) -> Iterator[int]:
    """Open the folder of a file and yield its descriptor; with ``make``, create missing folders.

    Raises `OSError` if a folder is missing or is a link.
    """
    folder = os.open(root, _FOLDER)
    try:
        for level in name.parent.parts:
            if make:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(level, _FOLDER_MODE, dir_fd=folder)
            below = os.open(level, _FOLDER | os.O_NOFOLLOW, dir_fd=folder)
            os.close(folder)
            folder = below
        yield folder
    finally:
        os.close(folder)


def open_below(root: Path, name: PurePath) -> BinaryIO:
    """Open a file to read. Raises `OSError` if it is a link or not a regular file."""
    with folder_of(root, name) as folder:
        descriptor = os.open(name.name, _READ, dir_fd=folder)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{name} is no regular file")
    return os.fdopen(descriptor, "rb")


def write_below(
    root: Path,
    name: PurePath,
    content: bytes,
    *,
    mode: int = _MODE,
    mtime_ns: int | None = None,
    sync: bool = False,
) -> int:
    """Write a file, or replace the file or link of that name. Returns its modification time in nanoseconds,
    as the file system rounds it.

    With ``sync`` the content is on the disk before the file gets its name, and the name when this returns.
    Raises `OSError`.
    """
    with folder_of(root, name, make=True) as folder:
        # Nobody can guess this name, so nobody can take it first.
        temporary = f".{secrets.token_hex(16)}.tmp"
        descriptor = os.open(temporary, _WRITE, _MODE, dir_fd=folder)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fchmod(descriptor, mode)
                if mtime_ns is not None:
                    os.utime(descriptor, ns=(mtime_ns, mtime_ns))
                if sync:
                    os.fsync(descriptor)
                written_ns = os.fstat(descriptor).st_mtime_ns
            os.replace(temporary, name.name, src_dir_fd=folder, dst_dir_fd=folder)
            if sync:
                os.fsync(folder)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary, dir_fd=folder)
            raise
    return written_ns


def make_private(path: Path) -> None:
    """Make sure that only the owner may read a file that another library opens by its name; create it if it
    is missing. Raises `OSError` if it is a link."""
    try:
        # An existing file is not opened: closing a file that SQLite has open would release SQLite's locks.
        os.close(os.open(path, _WRITE, _MODE))
    except FileExistsError:
        status = os.lstat(path)
        if stat.S_ISLNK(status.st_mode):
            raise OSError(f"{path} is a link, which is not followed: name the file itself") from None
        if stat.S_IMODE(status.st_mode) & 0o077:
            path.chmod(status.st_mode & 0o700)
