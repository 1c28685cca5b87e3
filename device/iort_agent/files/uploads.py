"""Uploads the finished files of folders in the background, one after the other."""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path

from iort_agent.clock import Clock
from iort_agent.common.state import Files
from iort_agent.errors import UploadError
from iort_agent.files.config import FilesConfig
from iort_agent.files.file import unreadable
from iort_agent.files.folder import HELD_S, Folder
from iort_agent.files.upload import Uploader

_log = logging.getLogger(__name__)

_SCAN_S = 2.0
# The kernel prefers the lanes to this thread.
_NICE = 10


class Uploads:
    """Uploads until it is stopped."""

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
        for folder in self._folders:
            name = folder.next()
            if name is not None:
                self._upload(folder, name, stop)
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
        except BaseException:
            # The thread starts again, with other files first.
            folder.hold(name, HELD_S)
            raise
        else:
            self._uploaded += 1
            _log.info("files: %s is uploaded as %s", folder.path / name, key)
            folder.uploaded(name, local, key)
        finally:
            self._current, self._current_bytes = None, 0

    def _progress(self, there: int) -> None:
        self._current_bytes = there


def make_uploads(files: FilesConfig, uploader: Uploader | None, clock: Clock) -> Uploads | None:
    """The uploads of a configuration that names a folder. Raises `UploadError` if ``large_folder`` cannot be
    created."""
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
    if not folders or uploader is None:
        return None
    return Uploads(folders=folders, uploader=uploader, clock=clock)
