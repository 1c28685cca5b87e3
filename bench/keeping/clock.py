"""A wall clock that the bench sets, for the embedded cloud with its functions and for the bench itself.

libfaketime reads the offset from a file. Pauses and timeouts follow the real, monotonic clock.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from bench.errors import BenchError

LIBRARY = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"), None)
_FILE = "FAKETIME_TIMESTAMP_FILE"
# A process looks into the file once a second.
_NOTICED_S = 1.1


class Clock:
    """The clock of this process, which `environment` started, and of all below it."""

    def __init__(self) -> None:
        self._file = Path(os.environ[_FILE])
        self._offset_s = 0

    def forward(self, seconds: int) -> None:
        """Set the clock forward, and wait until every process has noticed."""
        self._offset_s += seconds
        written = self._file.with_suffix(".new")
        written.write_text(f"+{self._offset_s}\n")
        written.rename(self._file)
        time.sleep(_NOTICED_S)


def environment(folder: Path) -> dict[str, str]:
    """The environment of a process with a clock of its own. Raises `BenchError` without libfaketime."""
    if LIBRARY is None:
        raise BenchError("libfaketime is not installed: apt install faketime")
    file = folder / "clock"
    file.write_text("+0\n")
    return {
        "LD_PRELOAD": str(LIBRARY),
        _FILE: str(file),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }


def inherited() -> dict[str, str]:
    """The part of this process' environment that `environment` made."""
    return {
        name: os.environ[name] for name in os.environ if name == "LD_PRELOAD" or name.startswith("FAKETIME_")
    }
