"""Child processes that end with us and whose log says why they stopped; the embedded cloud's errors."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NoReturn


class LocalError(Exception):
    """The embedded cloud cannot do what was asked. The text says why and what to do."""


class EmulatorError(LocalError):
    """The emulator ended, and nobody has stopped it; errors of its clients come from this."""


def interrupt_by_signals(stopped: threading.Event) -> None:
    """Let SIGINT, SIGTERM and SIGHUP set the event and raise `KeyboardInterrupt`."""

    def interrupt(_signal: int, _frame: object) -> NoReturn:
        # Python drops an exception that is raised while it forks, so the event is set too.
        stopped.set()
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)


_PR_SET_PDEATHSIG = 1
_TERMINATE_S = 10.0
_LOG_TAIL_LINES = 15


class Child:
    """A process in a session of its own, with its output in a log file, or in our own output without one.

    It gets the signal ``orphaned`` if we end without stopping it.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        cwd: Path,
        log: Path | None,
        orphaned: signal.Signals = signal.SIGTERM,
    ) -> None:
        self.name, self.log = name, log
        with ExitStack() as stack:
            output = None
            if log is not None:
                log.write_bytes(b"")
                # To its end, wherever that is: see `shorten_log`.
                output = stack.enter_context(log.open("ab"))
            try:
                self._process = subprocess.Popen(  # noqa: S603 - the command is ours
                    list(command),
                    env=dict(environment),
                    cwd=cwd,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=_die_with(os.getpid(), orphaned),  # noqa: PLW1509 - it takes no lock
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
        """Wait for its end and return its status; None if it still runs after ``timeout_s``."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def check(self) -> None:
        """Raise `LocalError` with the end of its log if it has stopped."""
        if self.poll() is not None:
            raise LocalError(self.ended())

    def ended(self) -> str:
        """How it has ended, in words, and the end of its log."""
        status = self._process.returncode
        how = f"was ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        return f"{self.name} {how}:\n{self.tail()}"

    def tail(self) -> str:
        """The last lines of its log."""
        if self.log is None:
            return "  (its output is above)"
        lines = self.log.read_text(errors="replace").splitlines()[-_LOG_TAIL_LINES:]
        return "\n".join(f"  {line[:300]}" for line in lines) + f"\n  ({self.log})"

    def shorten_log(self, most_bytes: int) -> None:
        """Begin the log anew once it is larger; one older part is kept, as ``<log>.1``."""
        if self.log is not None and self.log.stat().st_size > most_bytes:
            # There is no room for it on a full disk.
            with suppress(OSError):
                shutil.copyfile(self.log, f"{self.log}.1")
            os.truncate(self.log, 0)

    def interrupt(self) -> None:
        """Send SIGINT, on which it finishes its work."""
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """End it and its children: SIGTERM, and SIGKILL after ten seconds."""
        if self.poll() is None:
            self._process.terminate()
            self.wait(_TERMINATE_S)
        self.kill()

    def kill(self) -> None:
        """End it and its children at once."""
        # Its children are in its process group, and nobody else is.
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()


def _die_with(parent: int, number: signal.Signals) -> Callable[[], None] | None:
    """A function that makes the child end with us, however we end; None on systems other than Linux.

    It runs between fork and exec, where nothing may take a lock. So the library is loaded before.
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
    """Run a command to its end; raises `LocalError` with the last lines of its output if it fails."""
    child = Child(name, command, environment=environment, cwd=cwd, log=log)
    try:
        status = child.wait(timeout_s)
        if status is None:
            raise LocalError(f"{name} did not finish in {timeout_s:.0f} s:\n{child.tail()}")
        if status != 0:
            raise LocalError(f"{name} failed with status {status}:\n{child.tail()}")
    finally:
        child.stop()
