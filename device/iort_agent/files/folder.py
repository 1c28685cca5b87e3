"""Folders whose finished files are uploaded in the background, one after the other, oldest first.

What was uploaded, and what a file was found to hold, is kept in a small file in the folder, so that
the end of the process costs no second upload and no second reading.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Iterable, Iterator, NamedTuple

from iort_agent.clock import Clock
from iort_agent.common.private_files import folder_of, open_below, write_below
from iort_agent.common.schema import Place, any_path, number, setting
from iort_agent.errors import UploadError
from iort_agent.files.file import Local, Look, from_json, look_at, read, to_json
from iort_agent.files.upload import Uploader, make_uploader
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Uplink

_log = logging.getLogger(__name__)

STATE = ".iort-uploads.json"
_STATE = PurePath(STATE)
_SCAN_S = 2.0
_DEPTH = 6
# A file that cannot be uploaded as it is, is looked at again when it has changed; this only bounds
# how long a rule of the cloud's may hold it.
_REFUSED_AGAIN_S = 86_400.0
# Whatever the cloud says, a file that could not be uploaded waits so long the first time, twice as long the
# next, and so on up to the most.
_HELD_S, _MOST_HELD_S = 5.0, 300.0
# Of what is still being written: rosbag and rosbag2 rename when they are done.
_UNFINISHED = (".active", ".tmp", ".part", "-wal", "-shm", "-journal")
# Between the lanes and this thread, the kernel is to prefer the lanes.
_NICE = 10


def _folder(value: Any, where: Place) -> Path:
    path: Path = any_path()(value, where)
    if not path.is_dir():
        raise where.error(value, f"the path of a folder that exists, and there is none at {path}")
    return path


@dataclass(frozen=True)
class FilesConfig:
    """Files to upload. A file of ``folder`` is finished when it has not changed for ``settle_s``.
    ``remove_after_s`` after it was uploaded it is removed; without, it stays. ``rate_kb_s``: no more
    kilobytes (1000) a second than this, for all files; 0 for no limit.

    ``large_folder`` is where bytes wait that topics with ``large: upload`` give: at most one content
    every ``large_every_s`` of each stream, and no more than ``large_max_mb`` (1e6 bytes) in all.
    """

    folder: Path | None = setting(_folder, None)
    settle_s: float = setting(number(1, 86_400, unit="s"), 10.0)
    remove_after_s: float | None = setting(number(0, 365 * 86_400, unit="s"), None)
    rate_kb_s: float = setting(number(0, 1e6, unit="kB/s"), 1000.0)
    large_folder: Path | None = setting(any_path(), None)
    large_every_s: float = setting(number(0, 86_400, unit="s"), 1.0)
    large_max_mb: float = setting(number(1, 1e6, unit="MB"), 1000.0)


class Counts(NamedTuple):
    """What became of files since the start; ``waiting`` is as of now."""

    waiting: int
    uploaded: int
    sent_bytes: int


class Current(NamedTuple):
    """The file on its way and its bytes so far (None: no file is), and the last error of any file."""

    name: str | None
    sent_bytes: int
    last_error: str | None


class _Held(NamedTuple):
    look: Look
    until: float
    # How often in a row.
    times: int


class Folder:
    """One watched folder. Only its thread calls it; `waiting` may be read from any."""

    def __init__(self, path: Path, *, clock: Clock, settle_s: float, remove_after_s: float | None) -> None:
        self.path, self._clock = path, clock
        self._settle_s, self._remove_after_s = settle_s, remove_after_s
        self._state = path / STATE
        # By path below the folder: what it was and since when, by the monotonic clock.
        self._seen: dict[Path, tuple[Look, float]] = {}
        self._held: dict[Path, _Held] = {}
        self._read: dict[str, Any] = {}
        self._done: dict[str, Any] = {}
        self.waiting = 0
        self._load()

    def next(self) -> Path | None:
        """The oldest file that is finished and not uploaded, below the folder; removes what is due."""
        now = self._clock.monotonic()
        ready: list[tuple[int, Path]] = []
        waiting = 0
        found = dict(self._files())
        self._forget(found)
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

    def local(self, name: Path, stop: threading.Event) -> Local:
        """The file as it was read, now or before. Raises `UploadError`."""
        local = from_json(self.path, name, self._read.get(str(name), {}))
        if local is None:
            local = read(self.path, name, stop=stop)
            self._read[str(name)] = to_json(local)
            self._save()
        return local

    def uploaded(self, name: Path, local: Local, key: str) -> None:
        """The bucket has it."""
        self._read.pop(str(name), None)
        at_s = self._clock.now_us() // 1_000_000
        self._done[str(name)] = _done(local.look, key, at_s)
        self.waiting = max(0, self.waiting - 1)
        self._save()
        self._remove_if_due(name, self._done[str(name)])

    def hold(self, name: Path, again_s: float | None) -> None:
        """It could not be uploaded: not before then, unless it changes, and later each time in a row."""
        seen = self._seen.get(name)
        if seen is None:
            return
        held = self._held.get(name)
        times = held.times + 1 if held is not None and held.look == seen[0] else 1
        wait_s = max(
            _REFUSED_AGAIN_S if again_s is None else again_s,
            min(_MOST_HELD_S, _HELD_S * 2.0 ** min(times - 1, 20)),
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
                    # What a link leads to belongs to somebody else.
                    if entry.is_dir(follow_symlinks=False):
                        if depth < _DEPTH:
                            todo.append((Path(entry.path), depth + 1))
                    elif entry.is_file(follow_symlinks=False):
                        status = entry.stat(follow_symlinks=False)
                        name = Path(entry.path).relative_to(self.path)
                        yield name, Look(status.st_size, status.st_mtime_ns)
                except OSError:
                    continue  # gone since the folder was listed

    def _forget(self, found: dict[Path, Look]) -> None:
        """What is not there any more need not be remembered."""
        for names in (self._seen, self._held):
            for gone in [name for name in names if name not in found]:
                del names[gone]
        for saved in (self._read, self._done):
            for missing in [name for name in saved if Path(name) not in found]:
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
            with open_below(self.path, _STATE) as file:
                saved = json.load(file)
            self._read = dict(saved["read"])
            self._done = {name: _done(**done) for name, done in dict(saved["done"]).items()}
        except FileNotFoundError:
            pass
        except (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
            self._read, self._done = {}, {}
            # The cloud knows what it has: all that is lost is the time to read the files again.
            _log.warning("files: %s cannot be used and is begun anew: %s", self._state, error)

    def _save(self) -> None:
        content = json.dumps({"read": self._read, "done": self._done}).encode()
        try:
            write_below(self.path, _STATE, content)
        except OSError as error:
            _log.warning("files: %s: %s", self._state, error.strerror or error)


def _done(look: Iterable[int], key: str, at_s: float) -> dict[str, Any]:
    """What is kept of a file that was uploaded."""
    return {"look": [int(number) for number in look], "key": str(key), "at_s": int(at_s)}


class Uploads:
    """Uploads the finished files of its folders until it is stopped."""

    def __init__(self, *, folders: list[Folder], uploader: Uploader, clock: Clock) -> None:
        self._folders, self._uploader, self._clock = folders, uploader, clock
        self._uploaded = 0
        self._current: str | None = None
        self._current_bytes = 0
        self._last_error: str | None = None
        self._wake = threading.Event()

    def wake(self) -> None:
        """Look at the folders again: there is something, or nothing more to do."""
        self._wake.set()

    def run(self, stop: threading.Event) -> None:
        """Upload until ``stop`` is set; call `wake` after setting it."""
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        except (AttributeError, OSError):
            _log.debug("files: this system has no priority of a thread's own")
        while not stop.is_set():
            self._wake.clear()
            try:
                more = self.step(stop)
            except Exception:  # noqa: BLE001 - whatever a file system raises
                # One file that nobody thought of must not end the upload of all others.
                _log.exception("files: going on after an error")
                more = False
            if not more:
                self._clock.wait(self._wake, _SCAN_S)

    def step(self, stop: threading.Event) -> bool:
        """Upload the next file, if there is one; whether there was."""
        for folder in self._folders:
            name = folder.next()
            if name is not None:
                self._upload(folder, name, stop)
                return True
        return False

    def waiting(self) -> int:
        """Files seen and not uploaded yet."""
        return sum(folder.waiting for folder in self._folders)

    def counts(self) -> Counts:
        """What became of files."""
        return Counts(self.waiting(), self._uploaded, self._uploader.sent_bytes)

    def current(self) -> Current:
        """The upload that is under way, and the last error."""
        return Current(self._current, self._current_bytes, self._last_error)

    def _upload(self, folder: Folder, name: Path, stop: threading.Event) -> None:
        self._current, self._current_bytes = str(name), 0
        try:
            local = folder.local(name, stop)
            key = self._uploader.upload(local, stop, self._progress)
        except UploadError as error:
            if not stop.is_set():
                self._last_error = str(error)
                _log.warning("files: %s", error)
                folder.hold(name, error.again_s)
        except Exception:
            # Nobody thought of it, and the others wait.
            folder.hold(name, _HELD_S)
            raise
        else:
            self._uploaded += 1
            _log.info("files: %s is uploaded as %s", folder.path / name, key)
            folder.uploaded(name, local, key)
        finally:
            self._current, self._current_bytes = None, 0

    def _progress(self, there: int) -> None:
        self._current_bytes = there


def make_uploads(
    files: FilesConfig,
    *,
    robot: str,
    namespace: str,
    uplink: Uplink,
    clock: Clock,
    rate_limiter: RateLimiter,
    root_ca: Path | None,
) -> Uploads | None:
    """The uploads that the configuration asks for; None where it asks for none.

    Raises `UploadError` where ``large_folder`` cannot be made.
    """
    folders = []
    if files.large_folder is not None:
        try:
            files.large_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise UploadError(f"{files.large_folder}: {error.strerror or error}", again_s=None) from error
        folders.append(Folder(files.large_folder, clock=clock, settle_s=0.0, remove_after_s=0.0))
    if files.folder is not None:
        folders.append(
            Folder(files.folder, clock=clock, settle_s=files.settle_s, remove_after_s=files.remove_after_s)
        )
    if not folders:
        return None
    uploader = make_uploader(
        robot=robot,
        namespace=namespace,
        uplink=uplink,
        clock=clock,
        rate_limiter=rate_limiter,
        root_ca=root_ca,
        rate_kb_s=files.rate_kb_s,
    )
    return Uploads(folders=folders, uploader=uploader, clock=clock)
