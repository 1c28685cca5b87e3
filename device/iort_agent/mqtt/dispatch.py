"""One thread that runs callbacks in order, so that the network's own thread never waits for one."""

from __future__ import annotations

import logging
import queue
from typing import Callable

from iort_agent.common.threads import Supervised

_log = logging.getLogger(__name__)

Call = Callable[[], None]


class Dispatcher:
    """A queue of calls. `start` runs them in a thread; `run_pending` runs them in the calling thread."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self._thread = Supervised("callbacks", self._run)

    def post(self, call: Call) -> None:
        """Run a call later; returns at once, from any thread."""
        self._calls.put(call)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Run the queued calls, then end the thread."""
        if self._thread.is_alive():
            self._calls.put(None)
            self._thread.join(timeout_s)

    def run_pending(self) -> None:
        """Run the queued calls, and those that they queue."""
        while not self._calls.empty():
            call = self._calls.get()
            if call is not None:
                _guarded(call)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            _guarded(call)


def _guarded(call: Call) -> None:
    try:
        call()
    except Exception:  # noqa: BLE001 - whatever a callback raises
        # The thread must outlive a mistake in one callback; otherwise the agent would receive nothing more.
        _log.exception("a callback failed")
