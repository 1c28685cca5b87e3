"""One thread that runs callbacks in order, so that the network's own thread never waits for one."""

from __future__ import annotations

import logging
import queue
import threading
from typing import Callable

_log = logging.getLogger(__name__)

Call = Callable[[], None]


class Dispatcher:
    """A queue of calls. `start` runs them in a thread; without it, `run_pending` runs them here."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="callbacks", daemon=True)

    def post(self, call: Call) -> None:
        """Run a call later; returns at once, from any thread."""
        self._calls.put(call)

    def start(self) -> None:
        """Begin to run calls."""
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Run what is queued, then end the thread."""
        if self._thread.is_alive():
            self._calls.put(None)
            self._thread.join(timeout_s)

    def run_pending(self) -> None:
        """Run what is queued, and what that queues, in this thread."""
        while not self._calls.empty():
            self._call(self._calls.get())

    def _run(self) -> None:
        while True:
            call = self._calls.get()
            if call is None:
                return
            self._call(call)

    @staticmethod
    def _call(call: Call | None) -> None:
        try:
            if call is not None:
                call()
        except Exception:  # noqa: BLE001 - whatever a callback raises
            # The thread must outlive a mistake in one callback, or the agent would go deaf.
            _log.exception("a callback failed")
