"""What is written: files, of which none replaces another unasked and a part is never taken for the whole; and
texts of robots.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from iort_station.errors import StationError


def cache(environment: Mapping[str, str]) -> Path:
    """The user's folder for what can be made again."""
    home = environment.get("XDG_CACHE_HOME") or Path(environment.get("HOME", "~")).expanduser() / ".cache"
    return Path(home) / "iort"


def check_free(path: Path, *, force: bool) -> None:
    """Raise `StationError` if there is a file or a link already, unless ``force``."""
    if os.path.lexists(path) and not force:
        raise StationError(f"{path} exists: give another --out, or overwrite it with --force")


@contextmanager
def whole(path: Path, *, force: bool = False) -> Iterator[Path]:
    """The file to write, which is renamed to ``path`` after the block. A block that raises changes nothing.

    Raises `StationError` if ``path`` exists, unless ``force``.
    """
    check_free(path, force=force)
    if not path.parent.is_dir():
        raise StationError(f"{path} must be in a folder that exists")
    if path.exists() and not path.is_file():
        # A device or a pipe.
        yield path
        return
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, mark: str, kind: str, *, force: bool = False) -> Iterator[Path]:
    """The same for a folder, which must not exist yet when the block writes it.

    ``mark`` is a file that every ``kind`` has: ``force`` replaces no other folder.
    """
    check_free(path, force=force)
    if os.path.lexists(path) and not (path / mark).is_file():
        raise StationError(f"{path} is no {kind}: give another --out")
    if not path.parent.is_dir():
        raise StationError(f"{path} must be in a folder that exists")
    with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as temporary:
        # Files in it may have its name.
        part = Path(temporary) / path.name
        yield part
        before = Path(temporary) / "before"
        try:
            if path.exists():
                path.rename(before)
            part.rename(path)
        except BaseException:
            if before.exists() and not path.exists():
                before.rename(path)
            raise


def write_private(path: Path, content: str | bytes) -> None:
    """Write a file that only its owner can read; a reader sees the old one or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    parent = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(parent)
    finally:
        os.close(parent)


# Texts of robots, for a terminal or a spreadsheet to show and not to obey.

# C0 except tab and new line, DEL and C1, Unicode's line ends and directions, and halves of characters, which
# no output can write.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    """Replace each character that a terminal would obey by its code, as JSON spells it."""
    # JSON's spelling, so that JSON stays JSON.
    return _OBEYED.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: str) -> str:
    """The same, with the codes of line breaks and tabs, for a text among others: it must not begin a line."""
    return visible(text).replace("\n", "\\n").replace("\t", "\\t")
