"""Calls in a few threads, in which those who have calls waiting take turns."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)
_Call = tuple[Callable[..., object], tuple[Any, ...]]


class Turns:
    """Runs what is submitted in so many threads, which end with the process.

    Calls of one are in their order, and of several each has one before anybody has a second: who submits
    many makes nobody else wait for more than the calls that are running and one of each.
    """

    def __init__(self, threads: int) -> None:
        self._waiting: OrderedDict[str, deque[_Call]] = OrderedDict()
        self._changed = threading.Condition()
        for _ in range(threads):
            threading.Thread(target=self._run, daemon=True).start()

    def submit(self, whose: str, function: Callable[..., object], *arguments: Any) -> None:
        """Have the function called as soon as it is the turn of ``whose``."""
        with self._changed:
            self._waiting.setdefault(whose, deque()).append((function, arguments))
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                whose, calls = self._waiting.popitem(last=False)
                function, arguments = calls.popleft()
                if calls:
                    self._waiting[whose] = calls
            try:
                function(*arguments)
            except Exception:  # noqa: BLE001 - the others' calls are still to be made
                _log.exception("a call of %r failed", whose)
