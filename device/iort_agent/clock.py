"""Time, as a seam: tests pass a clock that needs no sleep."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Wall time, monotonic time and waiting; a test needs all three from one clock."""

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch; may jump."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never jumps."""

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Wait until the event is set or the seconds have passed; whether it is set."""


class SystemClock:
    """The machine's own clock."""

    def now_us(self) -> int:
        return time.time_ns() // 1000

    monotonic = staticmethod(time.monotonic)

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        return event.wait(seconds)


class Pace:
    """Deadlines counted from one start, so that small delays do not add up."""

    def __init__(self, clock: Clock, stop: threading.Event) -> None:
        self._clock = clock
        self._stop = stop
        self._start = clock.monotonic()

    def until(self, offset_s: float) -> bool:
        """Wait until ``offset_s`` after the start. False if ``stop`` is set. A late call returns at once."""
        remaining = self._start + offset_s - self._clock.monotonic()
        if remaining <= 0:
            return not self._stop.is_set()
        return not self._clock.wait(self._stop, remaining)
