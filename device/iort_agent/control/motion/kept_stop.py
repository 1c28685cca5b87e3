"""The emergency stop over a restart of the agent: a file beside the queue's, while it holds."""

from __future__ import annotations

import logging
import os
from pathlib import Path

_log = logging.getLogger(__name__)


class KeptStop:
    """`stopped` is what is in force, at first what the last run kept. Without a queue in a file the stop is
    known again once the agent is connected."""

    def __init__(self, queue: Path | None) -> None:
        self._file = queue.with_name(f"{queue.name}.stopped") if queue is not None else None
        self.stopped = self._kept = self._file is not None and self._file.exists()
        # Why the next run would not know it.
        self.alarm: str | None = None

    def keep(self, *, stopped: bool) -> None:
        """Keep it for the next run. A disk that does not work is no reason not to stop."""
        self.stopped = stopped
        self.tick()

    def tick(self) -> None:
        """Try again what the disk did not do."""
        if self._file is None or self.stopped == self._kept:
            return
        stopped = self.stopped
        try:
            if stopped:
                self._file.touch(mode=0o600)
            elif self._file.exists():
                self._file.unlink()
            folder = os.open(self._file.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            if self.alarm is None:
                _log.error("%s: the emergency stop cannot be kept over a restart: %s", self._file, error)
            self.alarm = f"{self._file}: a restart would not know the emergency stop or its end: {error}"
        else:
            self._kept, self.alarm = stopped, None
