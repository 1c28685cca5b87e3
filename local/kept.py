"""Folders in build/ that are made once, and made anew when what they are made of changes."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

_KEPT = 4


def kept(folder: Path, key: str, sources: Iterable[Path], make: Callable[[Path], object]) -> Path:
    """Return the folder below ``folder`` for the key and the sources' content; ``make`` fills a new one.

    Processes may call it at the same time. The oldest folders are removed.
    """
    digest = hashlib.sha256(f"{sys.version} {key}".encode())
    for source in sources:
        digest.update(f"{source}\0".encode() + source.read_bytes())
    found = folder / digest.hexdigest()[:16]
    if found.is_dir():
        found.touch()
        return found
    folder.mkdir(parents=True, exist_ok=True)
    making = found.with_suffix(f".{os.getpid()}")
    shutil.rmtree(making, ignore_errors=True)
    make(making)
    try:
        making.rename(found)
    except OSError:
        # Another process has made the same one meanwhile.
        shutil.rmtree(making, ignore_errors=True)
    by_age = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    for old in by_age[:-_KEPT]:
        shutil.rmtree(old, ignore_errors=True)
    return found
