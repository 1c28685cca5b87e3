"""Folders in build/ that are made once, and made anew when what they are made of changes."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from local.errors import LocalError

_KEPT = 4
# A folder that is still being made after this time was left by a process that ended.
_LEFT_S = 3600


def kept(folder: Path, key: str, sources: Iterable[Path], make: Callable[[Path], object]) -> Path:
    """Return the folder below ``folder`` for the key and the sources' content; ``make`` fills a new one.

    Processes may call it at the same time. The oldest folders are removed. Raises `LocalError` in a checkout
    that is another user's, if it has no such folder.
    """
    digest = hashlib.sha256(f"{sys.version} {key}".encode())
    for source in sources:
        digest.update(f"{source}\0".encode() + source.read_bytes())
    found = folder / digest.hexdigest()[:16]
    if found.is_dir():
        # A read-only checkout keeps what it has.
        with suppress(OSError):
            found.touch()
        return found
    there = next(one for one in (folder, *folder.parents) if one.exists())
    if not os.access(there, os.W_OK):
        raise LocalError(
            f"you must be able to write {there}: its owner must run this once, or use a checkout of your own"
        )
    folder.mkdir(parents=True, exist_ok=True)
    making = found.with_suffix(f".{os.getpid()}")
    shutil.rmtree(making, ignore_errors=True)
    make(making)
    try:
        making.rename(found)
    except OSError:
        # Another process has made the same one meanwhile.
        shutil.rmtree(making, ignore_errors=True)
    for old in _old(folder):
        shutil.rmtree(old, ignore_errors=True)
    return found


def _old(folder: Path) -> Iterator[Path]:
    """All folders but the newest ones, and but those that other processes are making."""
    made: list[tuple[float, Path]] = []
    for path in folder.iterdir():
        # Another process may have renamed or removed it meanwhile.
        with suppress(FileNotFoundError):
            changed_s = path.stat().st_mtime
            if not path.suffix:
                made.append((changed_s, path))
            elif time.time() - changed_s > _LEFT_S:
                yield path
    yield from (path for _, path in sorted(made)[:-_KEPT])
