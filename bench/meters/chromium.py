"""Opens the machine's Chromium; the installed playwright brings no browser."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from bench.errors import BenchError

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


@contextmanager
def opened() -> Iterator[Browser]:
    """Yield a browser. Raises `BenchError` without one."""
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only who has a browser needs it
    except ImportError as error:
        raise BenchError("playwright is not installed: run `make setup`") from error
    program = found()
    if program is None:
        raise BenchError("there is no chromium here: apt-get install chromium, or name it in CHROMIUM")
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()
