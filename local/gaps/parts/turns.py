"""A few threads that serve the owners of waiting calls in turn."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)
_Call = tuple[Callable[..., object], tuple[Any, ...]]


class Turns:
    """Runs submitted calls in a fixed number of daemon threads.

    The calls of one owner start in their order. Owners take turns: each gets one call before any gets two.
    """

    def __init__(self, threads: int) -> None:
        self._waiting: OrderedDict[str, deque[_Call]] = OrderedDict()
        self._changed = threading.Condition()
        for _ in range(threads):
            threading.Thread(target=self._run, daemon=True).start()

    def submit(self, whose: str, function: Callable[..., object], *arguments: Any) -> None:
        """Call the function when it is the turn of the owner ``whose``."""
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
            except Exception:  # noqa: BLE001 - the thread has to serve the other calls
                _log.exception("a call of %r failed", whose)
