"""A wall clock that the bench sets, for the embedded cloud with its functions and for the bench itself.

Pauses and timeouts follow the real, monotonic clock. The clock is a library of a few lines (clock.c), which
the system's C compiler makes.
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from pathlib import Path

from testkit.waiting import InstrumentError

_FILE, _PRELOAD = "BENCH_CLOCK", "LD_PRELOAD"


class Clock:
    """The clock of this process, which has an `environment`, and of all below it."""

    def __init__(self) -> None:
        self._path = Path(os.environ[_FILE])
        self._offset_s = 0

    def forward(self, seconds: int) -> None:
        """Set the clock forward for every process."""
        self._offset_s += seconds
        # They have it mapped: it must stay the same file.
        with self._path.open("r+b") as file:
            file.write(struct.pack("=q", self._offset_s))


def environment(folder: Path) -> dict[str, str]:
    """The environment of a process with a clock of its own. Raises `InstrumentError` without a C compiler."""
    compiler, library, file = shutil.which("cc"), folder / "clock.so", folder / "clock"
    if compiler is None:
        raise InstrumentError(
            "there is no C compiler, which makes the soak's clock: apt install gcc libc6-dev"
        )
    source = Path(__file__).with_name("clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl"], check=True)
    file.write_bytes(struct.pack("=q", 0))
    return {_PRELOAD: str(library), _FILE: str(file)}


def inherited() -> dict[str, str]:
    """The part of this process' environment that `environment` made."""
    return {name: os.environ[name] for name in (_PRELOAD, _FILE)}
