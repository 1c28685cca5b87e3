"""A folder whose finished files are uploaded, the oldest first.

A file in the folder keeps which files were uploaded, and the hashes of large ones that were read, so that a
restart neither uploads nor reads them twice. Each line is a file's newest state, null once it is gone. Lines
are appended, and written anew when most are out of force: a file costs the same, however many there are.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import deque
from pathlib import Path, PurePath
from typing import Any, Iterable, Iterator, NamedTuple

from iort_agent.clock import Clock
from iort_agent.common.private_files import folder_of, open_below, write_below
from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, Look, from_json, look_at, read, to_json

_log = logging.getLogger(__name__)

STATE = ".iort-uploads.jsonl"
# The whole state in one object, as earlier agents wrote it.
_OLD_STATE = ".iort-uploads.json"
# While files wait, the folder is looked through this often: each look costs as much as it has files.
_LOOK_S = 30.0
# The lines that may be out of force, beside as many as are in force.
_SPARE_LINES = 1000
_DEPTH = 6
# A file that was refused is tried again when it has changed, or after this time: the cloud's rules may
# change.
_REFUSED_AGAIN_S = 86_400.0
# The wait after a failure doubles from the first value to the last, whatever the cloud says.
HELD_S, _MOST_HELD_S = 5.0, 300.0
_APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
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
        # In the file of the state, by path below the folder.
        self._read: dict[str, Any] = {}
        self._done: dict[str, Any] = {}
        self._lines = 0
        self.waiting = 0
        # What the newest look through the folder found ready, the oldest first.
        self._ready: deque[Path] = deque()
        self._looked: float | None = None
        self._load()

    def next(self) -> Path | None:
        """The oldest finished file that is not uploaded, as its path below the folder. Also removes the
        uploaded files that are due, at each look through the folder."""
        now = self._clock.monotonic()
        while self._ready and self._looked is not None and now - self._looked < _LOOK_S:
            if self._is_ready(self._ready[0], now):
                return self._ready[0]
            self._ready.popleft()
        self._look(now)
        return self._ready[0] if self._ready else None

    def _is_ready(self, name: Path, now: float) -> bool:
        """Whether a file is still what it was at the newest look, and neither uploaded nor held since."""
        try:
            look = look_at(self.path, name)
        except (OSError, UploadError):
            return False
        seen, done, held = self._seen.get(name), self._done.get(str(name)), self._held.get(name)
        unchanged = seen is not None and seen[0] == look
        uploaded = done is not None and tuple(done["look"]) == look
        return unchanged and not uploaded and (held is None or held.look != look or now >= held.until)

    def _look(self, now: float) -> None:
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
        self.waiting, self._looked = waiting, now
        self._ready = deque(name for _, name in sorted(ready))

    def local(self, name: Path, stop: threading.Event) -> LocalFile:
        """The file with its hashes, read now or before. Raises `UploadError`."""
        local = from_json(self.path, name, self._read.get(str(name), {}))
        if local is None:
            local = read(self.path, name, stop=stop)
            # A file of one part is read again sooner than it is noted.
            if len(local.parts) > 1:
                self._read[str(name)] = to_json(local)
                self._note(str(name))
        return local

    def uploaded(self, name: Path, local: LocalFile, key: str) -> None:
        """Note that the bucket has the file."""
        self._read.pop(str(name), None)
        done = self._done[str(name)] = _done(local.look, key, self._clock.now_us() // 1_000_000)
        self.waiting = max(0, self.waiting - 1)
        self._note(str(name))
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
        for missing in (self._read.keys() | self._done.keys()) - kept:
            self._read.pop(missing, None)
            self._done.pop(missing, None)
            self._note(missing)

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
            for line in self._saved().splitlines():
                name, read_, done = json.loads(line)
                self._take(str(name), read_, done)
                self._lines += 1
        except (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
            self._read, self._done = {}, {}
            # The cloud knows which files it has, so the agent only reads them again.
            _log.warning("files: %s cannot be used and is replaced: %s", self.path / STATE, error)
            self._write()

    def _saved(self) -> str:
        """The lines of the state; an earlier agent's state becomes lines."""
        try:
            with open_below(self.path, PurePath(STATE)) as file:
                text = file.read().decode()
        except FileNotFoundError:
            try:
                with open_below(self.path, PurePath(_OLD_STATE)) as file:
                    saved = json.load(file)
            except FileNotFoundError:
                return ""
            for name in {**saved["read"], **saved["done"]}:
                self._take(name, saved["read"].get(name), saved["done"].get(name))
            self._write()
            return ""
        # The agent may have been killed in the middle of the last line.
        lines, newline, rest = text.rpartition("\n")
        if rest:
            _log.info("files: %s: its last line is not complete", self.path / STATE)
            with folder_of(self.path, PurePath(STATE)) as folder:
                file_ = os.open(STATE, _APPEND, dir_fd=folder)
            os.ftruncate(file_, len((lines + newline).encode()))
            os.close(file_)
        return lines

    def _take(self, name: str, read_: Any, done: Any) -> None:
        """Take a file's state as it was saved."""
        self._read.pop(name, None)
        self._done.pop(name, None)
        if read_ is not None:
            self._read[name] = dict(read_)
        if done is not None:
            self._done[name] = _done(**done)

    def _line(self, name: str) -> bytes:
        return json.dumps([name, self._read.get(name), self._done.get(name)]).encode() + b"\n"

    def _note(self, name: str) -> None:
        """Append a file's state."""
        self._lines += 1
        if self._lines > _SPARE_LINES + 2 * len(self._read.keys() | self._done.keys()):
            self._write()
            return
        try:
            with folder_of(self.path, PurePath(STATE)) as folder:
                file = os.open(STATE, _APPEND, 0o600, dir_fd=folder)
            with os.fdopen(file, "ab") as lines:
                lines.write(self._line(name))
        except OSError as error:
            _log.warning("files: %s: %s", self.path / STATE, error.strerror or error)

    def _write(self) -> None:
        """Write the state anew, without the lines that are no longer in force."""
        names = self._read.keys() | self._done.keys()
        self._lines = len(names)
        try:
            write_below(self.path, PurePath(STATE), b"".join(map(self._line, names)))
        except OSError as error:
            _log.warning("files: %s: %s", self.path / STATE, error.strerror or error)


def _done(look: Iterable[int], key: str, at_s: float) -> dict[str, Any]:
    """The saved state of an uploaded file."""
    return {"look": [int(number) for number in look], "key": str(key), "at_s": int(at_s)}
