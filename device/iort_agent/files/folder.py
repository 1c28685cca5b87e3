"""Folders whose finished files are uploaded in the background, one after the other, the oldest first.

A file in the folder keeps which files were uploaded, a line each, so that a restart does not read them again.
Lines are appended, and written anew when most are out of force: a file costs the same, however many there
are.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Callable, Iterator, NamedTuple, Sequence

from iort_agent.common.private_files import folder_of, open_below, write_below
from iort_agent.common.schema import FOLDER, number, path, setting
from iort_agent.common.state import Files
from iort_agent.common.threads import Clock
from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, Look, look_at, read, unreadable
from iort_agent.files.upload import GaveWayError, Uploader
from iort_contract.checks import json_text

_log = logging.getLogger(__name__)

STATE = ".iort-uploads.jsonl"
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


class _Done(NamedTuple):
    """An uploaded file, and when that was, in seconds since the epoch."""

    look: Look
    at_s: int


class Folder:
    """One folder. Only the upload's thread calls it; any thread may read `waiting`."""

    def __init__(
        self,
        path: Path,
        *,
        clock: Clock,
        settle_s: float,
        remove_after_s: float | None,
        on_uploaded: Callable[[Path, str], object] = lambda _name, _key: None,
    ) -> None:
        """``on_uploaded`` is called with a file's path below the folder and its key, before that is noted: if
        the process dies meanwhile, it is called again."""
        self.path, self._clock = path, clock
        self.on_uploaded = on_uploaded
        self._settle_s, self._remove_after_s = settle_s, remove_after_s
        # By path below the folder: its look, and since when, on the monotonic clock.
        self._seen: dict[Path, tuple[Look, float]] = {}
        self._held: dict[Path, _Held] = {}
        # The files that wait and were read.
        self._read: dict[Path, LocalFile] = {}
        # The uploaded files, and how many lines the file of the state has for them.
        self._done: dict[Path, _Done] = {}
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
        seen = self._seen.get(name)
        unchanged = seen is not None and seen[0] == look
        return unchanged and not self._is_uploaded(name, look) and not self._is_held(name, look, now)

    def _is_uploaded(self, name: Path, look: Look) -> bool:
        done = self._done.get(name)
        return done is not None and done.look == look

    def _is_held(self, name: Path, look: Look, now: float) -> bool:
        held = self._held.get(name)
        return held is not None and held.look == look and now < held.until

    def _look(self, now: float) -> None:
        ready: list[tuple[int, Path]] = []
        waiting = 0
        files = dict(self._files())
        for known in (self._seen, self._held, self._read, self._done):
            for name in known.keys() - files.keys():
                del known[name]
        for name, look in files.items():
            seen = self._seen.get(name)
            if seen is None or seen[0] != look:
                seen = self._seen[name] = (look, now)
            if self._is_uploaded(name, look):
                self._remove_if_due(name, self._done[name])
                continue
            waiting += 1
            if now - seen[1] >= self._settle_s and not self._is_held(name, look, now):
                ready.append((look.mtime_ns, name))
        self.waiting, self._looked = waiting, now
        self._ready = deque(name for _, name in sorted(ready))

    def local(self, name: Path, stop: threading.Event) -> LocalFile:
        """The file with its hashes, read now or before. Raises `UploadError`."""
        local = self._read.get(name)
        if local is None or look_at(self.path, name) != local.look:
            local = self._read[name] = read(self.path, name, stop=stop)
        return local

    def uploaded(self, name: Path, local: LocalFile) -> None:
        """Note that the bucket has the file."""
        self._read.pop(name, None)
        done = self._done[name] = _Done(local.look, self._clock.now_us() // 1_000_000)
        self.waiting = max(0, self.waiting - 1)
        self._note(name, done)
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

    def _remove_if_due(self, name: Path, done: _Done) -> None:
        if self._remove_after_s is None:
            return
        if self._clock.now_us() / 1e6 - done.at_s < self._remove_after_s:
            return
        try:
            if look_at(self.path, name) == done.look:
                with folder_of(self.path, name) as folder:
                    os.unlink(name.name, dir_fd=folder)
        except (OSError, UploadError) as error:
            _log.warning("files: %s cannot be removed: %s", self.path / name, error)

    def _load(self) -> None:
        """Take the saved state. The agent may have been killed in the middle of a line. The cloud knows which
        files it has, so the file of a damaged line is only read again."""
        try:
            with open_below(self.path, PurePath(STATE)) as file:
                lines = file.read().splitlines()
        except FileNotFoundError:
            return
        except OSError as error:
            _log.warning("files: %s cannot be used and is replaced: %s", self.path / STATE, error)
            lines = [b""]
        self._done = dict(filter(None, map(_saved, lines)))
        self._lines = len(self._done)
        if len(lines) > len(self._done):
            self._write()

    def _note(self, name: Path, done: _Done) -> None:
        """Append an uploaded file."""
        self._lines += 1
        if self._lines > _SPARE_LINES + 2 * len(self._done):
            self._write()
            return
        try:
            with folder_of(self.path, PurePath(STATE)) as folder:
                file = os.open(STATE, _APPEND, 0o600, dir_fd=folder)
            with os.fdopen(file, "ab") as lines:
                lines.write(_line(name, done))
        except OSError as error:
            _log.warning("files: %s: %s", self.path / STATE, error.strerror or error)

    def _write(self) -> None:
        """Write the state anew, without the lines that are no longer in force."""
        self._lines = len(self._done)
        try:
            content = b"".join(_line(name, done) for name, done in self._done.items())
            write_below(self.path, PurePath(STATE), content)
        except OSError as error:
            _log.warning("files: %s: %s", self.path / STATE, error.strerror or error)


def _line(name: Path, done: _Done) -> bytes:
    return json.dumps([str(name), *done.look, done.at_s]).encode() + b"\n"


def _saved(line: bytes) -> tuple[Path, _Done] | None:
    """What a line of the state says; None if it is damaged."""
    try:
        name, size, mtime_ns, at_s = json.loads(json_text(line, "a line"))
        return Path(name), _Done(Look(int(size), int(mtime_ns)), int(at_s))
    except (ValueError, TypeError, ArithmeticError):
        return None


@dataclass(frozen=True)
class FilesConfig:
    """Files to upload. A file in ``folder`` is finished when it has not changed for ``settle_s``. It is
    removed ``remove_after_s`` after its upload; without this setting it stays. ``rate_kb_s`` limits all
    uploads in kilobytes (1000) a second; 0 is no limit.

    Topics with ``large: upload`` put their contents into ``large_folder``: at most one every
    ``large_every_s``
    from each stream, and no more than ``large_max_mb`` (1e6 bytes) in all.
    """

    folder: Path | None = setting(FOLDER, None)
    settle_s: float = setting(number(1, 86_400, unit="s"), 10.0)
    remove_after_s: float | None = setting(number(0, 365 * 86_400, unit="s"), None)
    rate_kb_s: float = setting(number(0, 1e6, unit="kB/s"), 1000.0)
    large_folder: Path | None = setting(path(), None)
    large_every_s: float = setting(number(0, 86_400, unit="s"), 1.0)
    large_max_mb: float = setting(number(1, 1e6, unit="MB"), 1000.0)


_SCAN_S = 2.0
# The kernel prefers the lanes to this thread.
_NICE = 10


class Uploads:
    """Uploads until it is stopped. After each part, a file of a later folder gives way to those of earlier
    ones."""

    def __init__(self, *, folders: list[Folder], uploader: Uploader, clock: Clock) -> None:
        self._folders, self._uploader, self._clock = folders, uploader, clock
        self._uploaded = 0
        self._current: str | None = None
        self._current_bytes = 0
        self._last_error: str | None = None
        self._wake = threading.Event()
        # Look at the folders again, or check `stop`.
        self.wake = self._wake.set

    def run(self, stop: threading.Event) -> None:
        """Upload until ``stop`` is set; call `wake` after setting it."""
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        except (AttributeError, OSError):
            _log.debug("files: this system cannot set the priority of a thread")
        while not stop.is_set():
            self._wake.clear()
            if not self.step(stop):
                self._clock.wait(self._wake, _SCAN_S)

    def step(self, stop: threading.Event) -> bool:
        """Upload the next file; False if there is none."""
        for i, folder in enumerate(self._folders):
            name = folder.next()
            if name is not None:
                self._upload(folder, name, stop, self._folders[:i])
                return True
        return False

    def status(self) -> Files:
        """The counts since the start, the current file and the last error."""
        return Files(
            waiting=sum(folder.waiting for folder in self._folders),
            uploaded=self._uploaded,
            sent_bytes=self._uploader.sent_bytes,
            current=self._current,
            current_bytes=self._current_bytes,
            last_error=self._last_error,
        )

    def _upload(self, folder: Folder, name: Path, stop: threading.Event, earlier: Sequence[Folder]) -> None:
        def gives_way() -> bool:
            return any(other.next() is not None for other in earlier)

        self._current, self._current_bytes = str(name), 0
        try:
            local = folder.local(name, stop)
            key = self._uploader.upload(local, stop, self._progress, gives_way)
        except GaveWayError:
            _log.debug("files: %s gives way to others", folder.path / name)
        except UploadError as error:
            if not stop.is_set():
                self._last_error = str(error)
                _log.warning("files: %s", error)
                folder.hold(name, error.again_s)
        except BaseException:
            # The thread starts again, with other files first.
            folder.hold(name, HELD_S)
            raise
        else:
            folder.on_uploaded(name, key)
            self._uploaded += 1
            _log.info("files: %s is uploaded as %s", folder.path / name, key)
            folder.uploaded(name, local)
        finally:
            self._current, self._current_bytes = None, 0

    def _progress(self, there: int) -> None:
        self._current_bytes = there


def make_uploads(
    files: FilesConfig, uploader: Uploader | None, clock: Clock, last: Folder | None = None
) -> Uploads | None:
    """The uploads of a configuration that names a folder; the files of the ``last`` one wait until no others
    do. Raises `UploadError` if ``large_folder`` cannot be created."""
    folders = []
    if files.large_folder is not None:
        try:
            files.large_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise unreadable(files.large_folder, error, again_s=None) from error
        folders.append(Folder(files.large_folder, clock=clock, settle_s=0.0, remove_after_s=0.0))
    if files.folder is not None:
        folders.append(
            Folder(files.folder, clock=clock, settle_s=files.settle_s, remove_after_s=files.remove_after_s)
        )
    if last is not None:
        folders.append(last)
    if not folders or uploader is None:
        return None
    return Uploads(folders=folders, uploader=uploader, clock=clock)
