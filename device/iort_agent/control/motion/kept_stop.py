"""The emergency stop over a restart of the agent: a file beside the queue's, while it holds."""

from __future__ import annotations

import logging
import os
from pathlib import Path

_log = logging.getLogger(__name__)


class KeptStop:
    """`stopped` is what the last run kept. Without a queue in a file the stop is known again once the agent
    is connected."""

    def __init__(self, queue: Path | None) -> None:
        self._file = queue.with_name(f"{queue.name}.stopped") if queue is not None else None
        self.stopped = self._file is not None and self._file.exists()

    def keep(self, *, stopped: bool) -> None:
        """Keep it for the next run. A disk that does not work is no reason not to stop."""
        if self._file is None or stopped == self.stopped:
            return
        try:
            if stopped:
                self._file.touch(mode=0o600)
            else:
                self._file.unlink()
            folder = os.open(self._file.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            _log.error("%s: the emergency stop cannot be kept over a restart: %s", self._file, error)
        self.stopped = stopped
