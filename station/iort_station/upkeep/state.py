"""The state folder of a kept cloud, for those who copy or replace it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from iort_station import kept
from iort_station.errors import StationError

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
