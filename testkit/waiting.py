"""Waits for what no event announces. Every wait has an end, so that nothing hangs."""

from __future__ import annotations

import threading
import time
from typing import Callable, TypeVar

T = TypeVar("T")
# It only ends what hangs: CI's machine is shared, and may stand still for a minute.
GUARD_S = 240.0
# Looks often at first, then less: a look may be a request.
_FIRST_S, _SLOWER, _MOST_S = 0.02, 1.15, 0.5


class InstrumentError(Exception):
    """A measurement, a question or its means failed; the text says why. The root of their errors."""


def until(
    look: Callable[[], T | None],
    what: str = "what must become true",
    within_s: float = GUARD_S,
    *,
    poll_s: float | None = None,
) -> T:
    """The first true value of ``look``. Raises `InstrumentError` with ``what`` if none comes in time."""
    deadline, pause_s, never = time.monotonic() + within_s, poll_s or _FIRST_S, threading.Event()
    while not (value := look()):
        if time.monotonic() > deadline:
            raise InstrumentError(f"waited {within_s:g} s for {what}")
        never.wait(pause_s)
        pause_s = poll_s or min(_MOST_S, pause_s * _SLOWER)
    return value


def reached(look: Callable[[], object], *, within_s: float, poll_s: float | None = None) -> bool:
    """Whether ``look`` gave a true value in this time."""
    try:
        until(look, within_s=within_s, poll_s=poll_s)
    except InstrumentError:
        return False
    return True
