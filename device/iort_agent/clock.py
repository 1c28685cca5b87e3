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


class ManualClock:
    """A clock that stands still until told; waiting moves it, so a day passes in no time."""

    def __init__(self, *, now_us: int = 1_700_000_000_000_000, monotonic: float = 1000.0) -> None:
        self._now_us = now_us
        self._monotonic = monotonic
        self._lock = threading.Lock()

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch."""
        return self._now_us

    def monotonic(self) -> float:
        """Seconds that only `advance` and `wait` move."""
        return self._monotonic

    def advance(self, seconds: float) -> None:
        """Let both clocks go on."""
        with self._lock:
            self._now_us += round(seconds * 1_000_000)
            self._monotonic += seconds

    def set_wall(self, now_us: int) -> None:
        """Let the wall clock jump, as NTP does; the monotonic clock stays."""
        self._now_us = now_us

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Pass the time at once, unless the event is set already. Without a limit: really wait."""
        if seconds is None:
            return event.wait()
        if event.is_set():
            return True
        self.advance(max(0.0, seconds))
        return event.is_set()


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
