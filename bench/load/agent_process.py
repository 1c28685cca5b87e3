"""Runs the installed agent in its own process, to drive a robot for the bench."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from bench import ROOT
from bench.errors import BenchError
from iort_station.fleet.robots import Bundle

_COMMAND = str(Path(sys.executable).parent / "iort-agent")
_END_S = 120.0


class AgentProcess:
    """The agent of a bundle; it runs from `__enter__` to `__exit__`, which stops it in good order."""

    def __init__(self, bundle: Bundle, *, drain_s: float = 60.0) -> None:
        self.robot = bundle.robot
        self._bundle = bundle
        self._report = bundle.folder / "report.json"
        self._drain_s = drain_s
        self.process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        self._log = tempfile.TemporaryFile()
        self._start()
        return self

    def kill(self) -> int:
        """SIGKILL, and a new start in the same folder; returns the time of the kill in us since the epoch."""
        killed_us = time.time_ns() // 1000
        self.process.kill()
        self.process.wait()
        self._start()
        return killed_us

    def _start(self) -> None:
        self.started_us = time.time_ns() // 1000
        config = ["--config", str(self._bundle.config), "--report", str(self._report)]
        self.process = subprocess.Popen(
            [_COMMAND, "run", *config, "--drain-s", str(self._drain_s)],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._log.close()

    def finished(self) -> dict[str, Any]:
        """Wait for the end of its sources and the last delivery; return the agent's report."""
        status = self.process.wait(_END_S + self._drain_s)
        if status:
            self._log.seek(0)
            raise BenchError(f"the agent ended with status {status}: {self._log.read()[-800:]!r}")
        written: dict[str, Any] = json.loads(self._report.read_text())
        return written
