"""Polls a service until it shows a result."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from verify.errors import VerifyError

Found = TypeVar("Found")
_POLL_S = 0.5


def until(
    found: Callable[[], Found | None], what: str, *, within_s: float = 90.0, poll_s: float = _POLL_S
) -> Found:
    """The first true value of ``found``. Raises `VerifyError` with ``what`` where none comes in time."""
    deadline = time.monotonic() + within_s
    while not (value := found()):
        if time.monotonic() > deadline:
            raise VerifyError(f"{what}: nothing within {within_s:.0f} s")
        time.sleep(poll_s)
    return value
