"""Files in folders that others may write into: below the folder no link is followed, and what is written has
its name when it is whole, and is its owner's alone.

``root`` is trusted, as the configuration names it; ``name`` is the path below it.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from pathlib import Path, PurePath
from typing import BinaryIO, Iterator

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
# A pipe that somebody put there is opened and refused; without O_NONBLOCK it would be waited for.
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE, _FOLDER_MODE = 0o600, 0o700


@contextlib.contextmanager
def folder_of(root: Path, name: PurePath, *, make: bool = False) -> Iterator[int]:
    """A descriptor of the folder that a file is in; folders that are missing are made where ``make`` is set.

    Raises `OSError` where there is none, or a link in its place.
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
    """The file, to be read. Raises `OSError` for a link and for what is no regular file."""
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
    """Put a file in its place, also where another or a link is; its time in ns, as the file system keeps it.

    With ``sync`` the content is on the disk before it has its name. Raises `OSError`.
    """
    with folder_of(root, name, make=True) as folder:
        # A name that nobody can guess, so that nobody can take it first.
        beside = f".{secrets.token_hex(16)}.tmp"
        descriptor = os.open(beside, _WRITE, _MODE, dir_fd=folder)
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
            os.replace(beside, name.name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(beside, dir_fd=folder)
            raise
    return written_ns


def make_private(path: Path) -> None:
    """Have a file at the path that its owner alone may read, empty if it is new, before another library
    opens it by its name. Raises `OSError` where a link is in its place."""
    try:
        # Only a new file is opened: to close one that SQLite has open in this process ends SQLite's locks.
        os.close(os.open(path, _WRITE, _MODE))
    except FileExistsError:
        found = os.lstat(path)
        if stat.S_ISLNK(found.st_mode):
            raise OSError(f"{path} is a link, which is not followed: name the file itself") from None
        if stat.S_IMODE(found.st_mode) & 0o077:
            path.chmod(found.st_mode & 0o700)
