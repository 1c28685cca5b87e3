"""A folder whose finished files are uploaded, the oldest first.

A small file in the folder keeps which files were uploaded, and the hashes of those that were read. So a
restart neither uploads nor reads a file twice.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from pathlib import Path, PurePath
from typing import Any, Iterable, Iterator, NamedTuple

from iort_agent.clock import Clock
from iort_agent.common.private_files import folder_of, open_below, write_below
from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, Look, from_json, look_at, read, to_json

_log = logging.getLogger(__name__)

STATE = ".iort-uploads.json"
_DEPTH = 6
# A file that was refused is tried again when it has changed, or after this time: the cloud's rules may
# change.
_REFUSED_AGAIN_S = 86_400.0
# The wait after a failure doubles from the first value to the last, whatever the cloud says.
HELD_S, _MOST_HELD_S = 5.0, 300.0
# Suffixes of unfinished files. rosbag and rosbag2 rename a file when it is done.
_UNFINISHED = (".active", ".tmp", ".part", "-wal", "-shm", "-journal")


class _Held(NamedTuple):
    look: Look
    until: float
    # Failures in a row.
    times: int


class Folder:
    """One folder. Only the upload's thread calls it; any thread may read `waiting`."""

    def __init__(self, path: Path, *, clock: Clock, settle_s: float, remove_after_s: float | None) -> None:
        self.path, self._clock = path, clock
        self._settle_s, self._remove_after_s = settle_s, remove_after_s
        # By path below the folder: its look, and since when, on the monotonic clock.
        self._seen: dict[Path, tuple[Look, float]] = {}
        self._held: dict[Path, _Held] = {}
        # In the file, by path below the folder.
        self._read: dict[str, Any] = {}
        self._done: dict[str, Any] = {}
        self.waiting = 0
        self._load()

    def next(self) -> Path | None:
        """The oldest finished file that is not uploaded, as its path below the folder. Also removes the
        uploaded files that are due."""
        now = self._clock.monotonic()
        ready: list[tuple[int, Path]] = []
        waiting = 0
        found = dict(self._files())
        self._forget_missing(found)
        for name, look in found.items():
            seen = self._seen.get(name)
            if seen is None or seen[0] != look:
                seen = self._seen[name] = (look, now)
            done = self._done.get(str(name))
            if done is not None and tuple(done["look"]) == look:
                self._remove_if_due(name, done)
                continue
            waiting += 1
            held = self._held.get(name)
            if now - seen[1] >= self._settle_s and (held is None or held.look != look or now >= held.until):
                ready.append((look.mtime_ns, name))
        self.waiting = waiting
        return min(ready)[1] if ready else None

    def local(self, name: Path, stop: threading.Event) -> LocalFile:
        """The file with its hashes, read now or before. Raises `UploadError`."""
        local = from_json(self.path, name, self._read.get(str(name), {}))
        if local is None:
            local = read(self.path, name, stop=stop)
            self._read[str(name)] = to_json(local)
            self._save()
        return local

    def uploaded(self, name: Path, local: LocalFile, key: str) -> None:
        """Note that the bucket has the file."""
        self._read.pop(str(name), None)
        done = self._done[str(name)] = _done(local.look, key, self._clock.now_us() // 1_000_000)
        self.waiting = max(0, self.waiting - 1)
        self._save()
        self._remove_if_due(name, done)

    def hold(self, name: Path, again_s: float | None) -> None:
        """Note a failed upload: the file waits until it changes or ``again_s`` has passed, and longer after
        each failure in a row."""
        seen = self._seen.get(name)
        if seen is None:
            return
        held = self._held.get(name)
        times = held.times + 1 if held is not None and held.look == seen[0] else 1
        wait_s = max(
            _REFUSED_AGAIN_S if again_s is None else again_s,
            min(_MOST_HELD_S, HELD_S * 2.0 ** min(times - 1, 20)),
        )
        self._held[name] = _Held(seen[0], self._clock.monotonic() + wait_s, times)

    def _files(self) -> Iterator[tuple[Path, Look]]:
        todo = [(self.path, 0)]
        while todo:
            folder, depth = todo.pop()
            try:
                entries = list(os.scandir(folder))
            except OSError as error:
                _log.warning("files: %s: %s", folder, error.strerror or error)
                continue
            for entry in entries:
                if entry.name.startswith(".") or entry.name.endswith(_UNFINISHED):
                    continue
                try:
                    # Links are not followed: their targets may belong to somebody else.
                    if entry.is_dir(follow_symlinks=False):
                        if depth < _DEPTH:
                            todo.append((Path(entry.path), depth + 1))
                    elif entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        name = Path(entry.path).relative_to(self.path)
                        yield name, Look(status.st_size, status.st_mtime_ns)
                except OSError:
                    continue  # removed since the folder was listed

    def _forget_missing(self, found: dict[Path, Look]) -> None:
        for names in (self._seen, self._held):
            for name in names.keys() - found.keys():
                del names[name]
        kept = {str(name) for name in found}
        for saved in (self._read, self._done):
            for missing in saved.keys() - kept:
                del saved[missing]

    def _remove_if_due(self, name: Path, done: dict[str, Any]) -> None:
        if self._remove_after_s is None:
            return
        if self._clock.now_us() / 1e6 - done["at_s"] < self._remove_after_s:
            return
        try:
            if look_at(self.path, name) == tuple(done["look"]):
                with folder_of(self.path, name) as folder:
                    os.unlink(name.name, dir_fd=folder)
        except (OSError, UploadError) as error:
            _log.warning("files: %s cannot be removed: %s", self.path / name, error)

    def _load(self) -> None:
        try:
            with open_below(self.path, PurePath(STATE)) as file:
                saved = json.load(file)
            self._read = dict(saved["read"])
            self._done = {name: _done(**done) for name, done in dict(saved["done"]).items()}
        except FileNotFoundError:
            pass
        except (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
            self._read, self._done = {}, {}
            # The cloud knows which files it has, so the agent only reads them again.
            _log.warning("files: %s cannot be used and is replaced: %s", self.path / STATE, error)

    def _save(self) -> None:
        content = json.dumps({"read": self._read, "done": self._done}).encode()
        try:
            write_below(self.path, PurePath(STATE), content)
        except OSError as error:
            _log.warning("files: %s: %s", self.path / STATE, error.strerror or error)


def _done(look: Iterable[int], key: str, at_s: float) -> dict[str, Any]:
    """The saved state of an uploaded file."""
    return {"look": [int(number) for number in look], "key": str(key), "at_s": int(at_s)}
