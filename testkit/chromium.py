"""Opens the machine's Chromium; the installed playwright brings no browser."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import Self

from testkit import machine
from testkit.waiting import InstrumentError, reached

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# It opens only our own page on loopback, so it needs no sandbox, GPU or background network.
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def found() -> str | None:
    """Return the program in the variable CHROMIUM, or the installed one."""
    return os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")


def _program() -> str:
    program = found()
    if program is None:
        raise InstrumentError("there is no chromium here: apt-get install chromium, or name it in CHROMIUM")
    return program


@contextmanager
def opened() -> Iterator[Browser]:
    """Yield a browser. Raises `InstrumentError` without one."""
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only who has a browser needs it
    except ImportError as error:
        raise InstrumentError("playwright is not installed: run `make setup`") from error
    program = _program()
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


_START_S = 120.0


class Tabs:
    """Runs from `__enter__` to `__exit__`; ``url`` is where playwright connects. ``within`` is what a command
    begins with to run on another machine, whose ``url`` it is then."""

    def __init__(self, folder: Path, *, within: Sequence[str] = ()) -> None:
        self._profile, self._within = folder / "chromium", within
        self._process: subprocess.Popen[bytes]
        self.url = ""

    def __enter__(self) -> Self:
        own = ("--headless=new", "--remote-debugging-port=0", f"--user-data-dir={self._profile}")
        self._process = subprocess.Popen(
            [*self._within, _program(), *FLAGS, *own, "about:blank"],
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        port = self._profile / "DevToolsActivePort"
        if not reached(lambda: port.exists() and port.read_text(), within_s=_START_S):
            self._process.kill()
            raise InstrumentError("chromium does not start")
        self.url = f"http://127.0.0.1:{port.read_text().split()[0]}"
        return self

    def __exit__(self, *_: object) -> None:
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
        return [self._process.pid, *machine.descendants(self._process.pid)]

    def signal(self, number: int) -> None:
        for pid in self.processes():
            os.kill(pid, number)

    def _ask(self, method: str, path: str) -> Any:
        request = urllib.request.Request(f"{self.url}{path}", method=method)  # noqa: S310 - of the browser above
        with urllib.request.urlopen(request, timeout=_START_S) as answer:  # noqa: S310 - as above
            body = answer.read()
        return json.loads(body) if body.startswith(b"{") else None
