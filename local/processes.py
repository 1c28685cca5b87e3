"""Child processes that never outlive us and never hide why they stopped."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from local.errors import LocalError

_PR_SET_PDEATHSIG = 1
_TERMINATE_S = 10.0
_LOG_TAIL_LINES = 15


class Child:
    """A process in a session of its own, with its output in a log file.

    ``orphaned`` is the signal it gets when we end without stopping it.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        cwd: Path,
        log: Path,
        orphaned: signal.Signals = signal.SIGTERM,
    ) -> None:
        self.name, self.log = name, log
        with log.open("wb") as output:
            try:
                self._process = subprocess.Popen(  # noqa: S603 - the command is ours
                    list(command),
                    env=dict(environment),
                    cwd=cwd,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=_die_with(os.getpid(), orphaned),  # noqa: PLW1509 - see there
                )
            except OSError as error:
                raise LocalError(f"{name} cannot be started: {error}") from error

    @property
    def pid(self) -> int:
        """The process id, which is also the id of its session."""
        return self._process.pid

    def poll(self) -> int | None:
        """The exit status, or None while it runs."""
        return self._process.poll()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for the end; None if it still runs after ``timeout_s``."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def check(self) -> None:
        """Raise `LocalError`, with the end of its log, if it has stopped."""
        if (status := self.poll()) is not None:
            raise LocalError(f"{self.name} stopped with status {status}:\n{self.tail()}")

    def tail(self) -> str:
        """The last lines of its log."""
        lines = self.log.read_text(errors="replace").splitlines()[-_LOG_TAIL_LINES:]
        return "\n".join(f"  {line[:300]}" for line in lines) + f"\n  ({self.log})"

    def interrupt(self) -> None:
        """Ask it to finish what it has begun."""
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """End it and whatever it started: politely first, for certain after ten seconds."""
        if self.poll() is None:
            self._process.terminate()
            self.wait(_TERMINATE_S)
        self.kill()

    def kill(self) -> None:
        """End it and whatever it started at once: it has nothing to put in order."""
        # Workers share the session; the group's id is the child's, so this reaches nobody else.
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()


def _die_with(parent: int, number: signal.Signals) -> Callable[[], None] | None:
    """What makes a child end when we do, however we do (Linux); None where that cannot be said.

    It runs between fork and exec, where only what needs no lock may be called: the library is loaded
    and its function found before.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl

    def ask() -> None:
        prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:
            os._exit(1)

    return ask


def run(
    name: str,
    command: Sequence[str],
    *,
    environment: Mapping[str, str],
    cwd: Path,
    log: Path,
    timeout_s: float,
) -> None:
    """Run a command to its end; raises `LocalError` with the end of its output if it fails."""
    child = Child(name, command, environment=environment, cwd=cwd, log=log)
    try:
        status = child.wait(timeout_s)
        if status is None:
            raise LocalError(f"{name} did not finish in {timeout_s:.0f} s:\n{child.tail()}")
        if status != 0:
            raise LocalError(f"{name} failed with status {status}:\n{child.tail()}")
    finally:
        child.stop()
