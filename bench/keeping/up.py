"""The process of `make up`, which the bench kills and starts again as systemd would."""

from __future__ import annotations

import os
import signal
import ssl
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from typing_extensions import Self

from iort_station import kept
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.errors import StationError
from local.processes import Child
from testkit import ROOT, machine
from testkit.waiting import InstrumentError

_FIRST_S, _AGAIN_S = 600.0, 120.0
_POLL_S = 0.05


class Up:
    """A kept cloud in a folder, from `__enter__` to `__exit__`."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.cloud: Cloud
        self._child: Child

    def __enter__(self) -> Self:
        self._start()
        file = self.state / EMBEDDED.name
        self._wait_for(file.exists, _FIRST_S)
        # The file is there only while the cloud is up, and a kept cloud has the same address and keys again.
        self.cloud = Cloud.load(file)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.stop()

    @property
    def emulator(self) -> int | None:
        """The emulator's process; None while there is none."""
        for pid in machine.descendants(self._child.pid):
            with suppress(OSError):
                if b"local.emulator.run" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    return pid
        return None

    def kill_emulator(self) -> float:
        """SIGKILL to the emulator and its functions; returns the seconds until it answers again."""
        if (pid := self.emulator) is not None:
            _kill([pid, *machine.descendants(pid)])
        return self._answering()

    def kill_all(self) -> float:
        """SIGKILL to every process of the cloud at once, and a new start; returns as `kill_emulator`."""
        _kill([self._child.pid, *machine.descendants(self._child.pid)])
        self._child.kill()
        self._start()
        return self._answering()

    def kill_function(self) -> float:
        """SIGKILL to the processes of the functions."""
        if (pid := self.emulator) is not None:
            _kill(machine.descendants(pid))
        return 0.0

    def wait_until_whole(self) -> None:
        """Wait until `make up` has done everything that belongs to a start."""

        def whole() -> bool:
            with suppress(StationError, OSError):
                return kept.Up.load(self.state).pids["up"] == self._child.pid
            return False

        self._wait_for(whole, _AGAIN_S)

    def _start(self) -> None:
        self._child = Child(
            "make up",
            # The machine may have a cloud of its user, too.
            [sys.executable, "-m", "local.up.run", "--state", str(self.state), "--ports", "any"],
            environment=dict(os.environ),
            cwd=ROOT,
            log=self.state.parent / "up.log",
        )

    def _answering(self) -> float:
        began, cloud = time.monotonic(), self.cloud
        context = ssl.create_default_context(cafile=cloud.ca_bundle)

        def answers() -> bool:
            with suppress(urllib.error.URLError, ConnectionError, TimeoutError):
                url = f"{cloud.endpoint_url}/_ministack/ready"
                with urllib.request.urlopen(url, timeout=5, context=context):  # noqa: S310 - always https
                    return True
            return False

        self._wait_for(answers, _AGAIN_S)
        return time.monotonic() - began

    def _wait_for(self, condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if self._child.poll() is not None and deadline - time.monotonic() < _AGAIN_S:
                # An emulator that ends too often ends it.
                self._start()
            if time.monotonic() > deadline:
                raise InstrumentError(f"the cloud is not up after {seconds:.0f} s:\n{self._child.tail()}")
            self._child.wait(_POLL_S)


def _kill(pids: list[int]) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
