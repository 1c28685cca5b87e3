"""Logs a repeated warning at most once a minute for each reason, with the number of repetitions."""

from __future__ import annotations

import logging
import threading

from iort_agent.clock import Clock

PERIOD_S = 60.0


class ThrottledLog:
    """Counts warnings by reason. The first one of a reason is logged at once, later ones once a minute."""

    def __init__(self, log: logging.Logger, clock: Clock) -> None:
        self._log = log
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._logged: dict[str, tuple[float, int]] = {}

    def warn(self, reason: str, text: str) -> None:
        """Count the reason; log the text unless this reason was logged less than a minute ago."""
        now = self._clock.monotonic()
        with self._lock:
            count = self._counts[reason] = self._counts.get(reason, 0) + 1
            at, before = self._logged.get(reason, (float("-inf"), 0))
            if now - at < PERIOD_S:
                return
            self._logged[reason] = (now, count)
        more = f" (and {count - before - 1} more like it)" if count - before > 1 else ""
        self._log.warning("%s%s", text, more)

    def counts(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)
