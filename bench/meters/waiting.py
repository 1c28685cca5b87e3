"""Waits for what no event announces."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from bench.errors import BenchError


def reached(true: Callable[[], object], *, within_s: float, poll_s: float = 0.1) -> bool:
    """Ask until the answer is true; return False if it never was in this time."""
    deadline = time.monotonic() + within_s
    while not true():
        if time.monotonic() > deadline:
            return False
        threading.Event().wait(poll_s)
    return True


def wait_for(true: Callable[[], object], what: str, within_s: float = 30.0, *, poll_s: float = 0.1) -> None:
    """Ask until the answer is true. Raises `BenchError` with ``what`` if it never was in this time."""
    if not reached(true, within_s=within_s, poll_s=poll_s):
        raise BenchError(f"waited {within_s:.0f} s for {what}")
