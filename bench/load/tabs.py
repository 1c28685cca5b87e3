"""A Chromium whose tabs are really hidden: playwright keeps every page visible that it holds."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from bench.errors import BenchError
from bench.meters import chromium, usage
from bench.meters.waiting import reached

_START_S = 30.0


class Tabs:
    """Runs from `__enter__` to `__exit__`; ``url`` is where playwright connects."""

    def __init__(self, folder: Path) -> None:
        self._profile = folder / "chromium"
        self._process: subprocess.Popen[bytes]
        self.url = ""

    def __enter__(self) -> Self:
        program = chromium.found()
        if program is None:
            raise BenchError("there is no chromium here: apt-get install chromium, or name it in CHROMIUM")
        own = ("--headless=new", "--remote-debugging-port=0", f"--user-data-dir={self._profile}")
        self._process = subprocess.Popen(
            [program, *chromium.FLAGS, *own, "about:blank"], stderr=subprocess.DEVNULL, start_new_session=True
        )
        told = self._profile / "DevToolsActivePort"
        if not reached(lambda: told.exists() and told.read_text(), within_s=_START_S):
            self._process.kill()
            raise BenchError("chromium does not start")
        self.url = f"http://127.0.0.1:{told.read_text().split()[0]}"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.signal(signal.SIGCONT)
        self._process.terminate()
        self._process.wait()

    def cover(self) -> str:
        """Open a tab before the one that is shown; returns its id."""
        tab = self._ask("PUT", "/json/new?about:blank")
        self._ask("GET", f"/json/activate/{tab['id']}")
        return str(tab["id"])

    def uncover(self, tab: str) -> None:
        """Close a tab that covers another one."""
        self._ask("GET", f"/json/close/{tab}")

    def processes(self) -> list[int]:
        return [self._process.pid, *usage.descendants(self._process.pid)]

    def signal(self, number: int) -> None:
        for pid in self.processes():
            os.kill(pid, number)

    def _ask(self, method: str, path: str) -> Any:
        request = urllib.request.Request(f"{self.url}{path}", method=method)  # noqa: S310 - of the browser above
        with urllib.request.urlopen(request, timeout=_START_S) as answer:  # noqa: S310 - as above
            body = answer.read()
        return json.loads(body) if body.startswith(b"{") else None
