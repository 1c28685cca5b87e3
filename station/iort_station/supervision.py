"""Long-lived threads and tasks that no unexpected exception ends: it is logged, and they start again."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable

_log = logging.getLogger("iort")
_SHORTEST_S, _LONGEST_S = 0.5, 30.0


def keep(name: str, work: Callable[[], None], ended: threading.Event) -> None:
    """Run ``work`` in this thread until it returns, again after each exception, or until ``ended`` is set."""
    pause_s = _SHORTEST_S
    while True:
        try:
            return work()
        except Exception:  # noqa: BLE001 - logged
            _alarm(name, pause_s)
        if ended.wait(pause_s):
            return None
        pause_s = min(2 * pause_s, _LONGEST_S)


async def keep_task(name: str, work: Callable[[], Awaitable[None]]) -> None:
    """As `keep`, of a task, which ends when it is cancelled."""
    pause_s = _SHORTEST_S
    while True:
        try:
            return await work()
        except Exception:  # noqa: BLE001 - logged
            _alarm(name, pause_s)
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_S)


def _alarm(name: str, pause_s: float) -> None:
    _log.exception("%s has failed unexpectedly; it starts again in %g s", name, pause_s)
