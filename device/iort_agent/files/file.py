"""A file of the robot, described as the contract does: name, kind, type, size and hashes."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import threading
from pathlib import Path, PurePath
from typing import BinaryIO, NamedTuple, Sequence

from iort_agent.common.private_files import folder_of, open_below
from iort_agent.errors import UploadError
from iort_contract.messages.files import MAX_FILE_BYTES, PART_BYTES, File

_CHUNK_BYTES = 256 * 1024
_AGAIN_S = 10.0
_LEVELS, _LEVEL_CHARACTERS = 4, 100

# Kind and content type by suffix.
_SUFFIXES = {
    ".bin": ("message", "application/octet-stream"),
    ".bag": ("recording", "application/x-rosbag"),
    ".mcap": ("recording", "application/x-mcap"),
    ".db3": ("recording", "application/vnd.sqlite3"),
    ".csv": ("log", "text/csv"),
    ".json": ("other", "application/json"),
    ".yaml": ("other", "application/yaml"),
    ".log": ("log", "text/plain"),
    ".txt": ("log", "text/plain"),
    ".jpg": ("image", "image/jpeg"),
    ".jpeg": ("image", "image/jpeg"),
    ".png": ("image", "image/png"),
    ".mp4": ("recording", "video/mp4"),
}


class Look(NamedTuple):
    """Size and modification time: a file with another look has changed."""

    size: int
    mtime_ns: int


class LocalFile(NamedTuple):
    """A file that was read once: its description, and the SHA-256 of each of its parts. No link below
    ``root`` is followed."""

    root: Path
    name: PurePath
    look: Look
    file: File
    parts: Sequence[str]

    @property
    def path(self) -> Path:
        return self.root / self.name

    @property
    def parts_sha256(self) -> str:
        """The SHA-256 of the parts' SHA-256, in order."""
        return hashlib.sha256(b"".join(bytes.fromhex(part) for part in self.parts)).hexdigest()

    def open(self) -> BinaryIO:
        """Open it to read. Raises `OSError`."""
        return open_below(self.root, self.name)


def unreadable(path: Path, error: OSError, *, again_s: float | None) -> UploadError:
    """The error for a file that cannot be read."""
    return UploadError(f"{path}: {error.strerror or error}", again_s=again_s)


def changed(path: Path) -> UploadError:
    """The error for a file that has changed since it was read."""
    return UploadError(f"{path}: changed during its upload; it is tried again", again_s=_AGAIN_S)


def look_at(root: Path, name: PurePath) -> Look:
    """Size and time of a file. Raises `UploadError` if it is missing or not a regular file."""
    try:
        with folder_of(root, name) as folder:
            status = os.stat(name.name, dir_fd=folder, follow_symlinks=False)
    except OSError as error:
        raise unreadable(root / name, error, again_s=None) from error
    if not stat.S_ISREG(status.st_mode):
        raise UploadError(f"{root / name}: is no regular file", again_s=None)
    return Look(status.st_size, status.st_mtime_ns)


def wire_name(path: PurePath) -> str:
    """The file's name as the contract allows it: other characters become ``_``, and all below the fourth
    level becomes one level."""
    levels = [_level(part) for part in path.parts]
    if len(levels) > _LEVELS:
        levels = [*levels[: _LEVELS - 1], "_".join(levels[_LEVELS - 1 :])]
    return "/".join(level[-_LEVEL_CHARACTERS:].lstrip("._-") or "file" for level in levels)


def _level(part: str) -> str:
    clean = re.sub(r"[^A-Za-z0-9._-]", "_", part)
    return clean if clean[0].isalnum() else f"x{clean}"


def kind_of(path: PurePath) -> tuple[str, str]:
    """Kind and content type, by the suffix."""
    return _SUFFIXES.get(path.suffix.lower(), ("other", "application/octet-stream"))


def read(root: Path, name: PurePath, *, stop: threading.Event) -> LocalFile:
    """Read the file once and compute its hashes.

    Raises `UploadError` if it cannot be read, changes meanwhile, is too large, or ``stop`` is set.
    """
    path, look = root / name, look_at(root, name)
    if look.size > MAX_FILE_BYTES:
        raise UploadError(f"{path}: must have at most {MAX_FILE_BYTES} bytes, got {look.size}", again_s=None)
    whole, parts, read_bytes = hashlib.sha256(), [], 0
    try:
        with open_below(root, name) as file:
            part = hashlib.sha256()
            while chunk := file.read(_CHUNK_BYTES):
                if stop.is_set():
                    raise UploadError(f"{path}: stopped", again_s=0)
                # A part is a whole number of chunks, and a regular file gives whole chunks.
                whole.update(chunk)
                part.update(chunk)
                read_bytes += len(chunk)
                if read_bytes % PART_BYTES == 0:
                    parts.append(part.hexdigest())
                    part = hashlib.sha256()
            if read_bytes % PART_BYTES or not parts:
                parts.append(part.hexdigest())
    except OSError as error:
        raise unreadable(path, error, again_s=_AGAIN_S) from error
    if read_bytes != look.size or look_at(root, name) != look:
        raise changed(path)
    kind, content_type = kind_of(path)
    file_ = File(
        name=wire_name(name),
        kind=kind,
        content_type=content_type,
        size=look.size,
        sha256=whole.hexdigest(),
        t_us=max(0, look.mtime_ns // 1000),
    )
    return LocalFile(root, name, look, file_, parts)
