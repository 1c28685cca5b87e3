"""Time, injected wherever it matters, so that tests need not sleep."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Wall time, monotonic time and waiting, which belong together in a test."""

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch; may jump."""

    def monotonic(self) -> float:
        """Seconds that never jump, from an arbitrary start."""

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Wait until the event is set or the seconds have passed; whether it is set."""


class SystemClock:
    """The machine's own clock."""

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch."""
        return time.time_ns() // 1000

    # Seconds of the monotonic clock, which every thread shares.
    monotonic = staticmethod(time.monotonic)

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Wait in real time."""
        return event.wait(seconds)


class Pace:
    """Absolute deadlines, ``period_s`` apart, so that small delays do not add up to a drift."""

    def __init__(self, clock: Clock, stop: threading.Event) -> None:
        self._clock = clock
        self._stop = stop
        self._start = clock.monotonic()

    def until(self, offset_s: float) -> bool:
        """Wait until ``offset_s`` after the start; False when asked to stop. Late is not made up for."""
        remaining = self._start + offset_s - self._clock.monotonic()
        if remaining <= 0:
            return not self._stop.is_set()
        return not self._clock.wait(self._stop, remaining)
