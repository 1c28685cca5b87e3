"""Says what happens again and again at most once a minute for each reason, and how often it did."""

from __future__ import annotations

import logging
import threading

from iort_agent.clock import Clock

PERIOD_S = 60.0


class ThrottledLog:
    """Counts by reason; the first of a reason is logged at once, later ones once a minute."""

    def __init__(self, log: logging.Logger, clock: Clock) -> None:
        self._log = log
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._told: dict[str, tuple[float, int]] = {}

    def warn(self, reason: str, text: str) -> None:
        """Count the reason and, if it is time, log the text."""
        now = self._clock.monotonic()
        with self._lock:
            count = self._counts[reason] = self._counts.get(reason, 0) + 1
            at, before = self._told.get(reason, (float("-inf"), 0))
            if now - at < PERIOD_S:
                return
            self._told[reason] = (now, count)
        more = f" (and {count - before - 1} more like it)" if count - before > 1 else ""
        self._log.warning("%s%s", text, more)

    def counts(self) -> dict[str, int]:
        """How often each reason came."""
        with self._lock:
            return dict(self._counts)
