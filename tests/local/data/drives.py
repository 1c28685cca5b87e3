"""Drives with distinguishable samples: the real agent plays a log of a counter."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from iort_agent.errors import AgentError
from iort_agent.status import SOCKET, fetch
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from testkit.waiting import until

RATE_HZ = 50
# The log's column and the contract's field of the counter.
_COLUMN, FIELD = "erpm", "speed"


def counter_log(path: Path, seconds: float) -> Path:
    """Write a VESC Tool log whose speed counts the samples from 0."""
    count = int(seconds * RATE_HZ)
    step_ms = 1000 // RATE_HZ
    rows = (f"{1000 + i * step_ms};12.0;{i}" for i in range(count))
    path.write_text("\n".join([f"ms_today;input_voltage;{_COLUMN}", *rows]) + "\n")
    return path


def counted(embedded: EmbeddedCloud, robot: str) -> list[int]:
    """Return the counter from the table in order; batches of a run must be numbered in order, too."""
    batches = list(audit.batches(embedded.cloud, robot, "vesc"))
    for boot in {batch.boot for batch in batches}:
        seqs = [batch.seq for batch in batches if batch.boot == boot]
        assert seqs == sorted(set(seqs)), "a batch number is repeated or out of order"
    return [int(value) for batch in batches for value in batch.columns[FIELD]]


class Agent:
    """The installed agent in a process; ``before`` wraps its command, ``environment`` adds variables."""

    def __init__(
        self,
        bundle: robots.Bundle,
        *,
        drain_s: float = 60,
        before: Sequence[str] = (),
        environment: dict[str, str] | None = None,
    ) -> None:
        self._report = bundle.folder / "report.json"
        self._socket = bundle.folder / SOCKET
        command = [str(Path(sys.executable).parent / "iort-agent"), "run", "--config", str(bundle.config)]
        self.process = subprocess.Popen(
            [*before, *command, "--report", str(self._report), "--drain-s", str(drain_s)],
            cwd=ROOT,
            env={**os.environ, **(environment or {})},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.log: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it cleanly, and check that it has."""
        self.stop()
        self.report()

    def _read(self) -> None:
        assert self.process.stderr is not None
        with self.process.stderr as lines:
            self.log.extend(lines)

    def said(self, text: str) -> bool:
        """Return whether a log line contains the text."""
        return any(text in line for line in self.log)

    def status(self) -> dict[str, Any]:
        """Return what `iort-agent status` asks for; empty while no agent answers."""
        try:
            return fetch(self._socket)
        except AgentError:
            return {}

    def told(self) -> dict[str, Any]:
        """Return the status as soon as it answers: a busy machine may leave it no time."""
        answer: dict[str, Any] = until(self.status)
        return answer

    def stop(self) -> None:
        """End it cleanly, as Ctrl-C and systemd do."""
        self.process.terminate()

    def kill(self) -> None:
        """End it as `kill -9` does."""
        self.process.kill()
        self.process.wait()
        self._reader.join()

    def report(self, *, timeout_s: float = 300, status: int = 0) -> dict[str, Any]:
        """Wait for the end with that status; return its report."""
        ended = self.process.wait(timeout_s)
        self._reader.join()
        assert ended == status, "".join(self.log[-30:])
        report: dict[str, Any] = json.loads(self._report.read_text())
        return report
