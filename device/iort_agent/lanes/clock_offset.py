"""The cloud's clock minus the robot's, measured by pings that a rule stamps with the cloud's time.

Cristian's method: the stamp was made between sending and receiving, so the middle of the two is wrong by at
most half the round trip. The offset is kept against the monotonic clock, so that it stays right when the wall
clock is set.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

from iort_agent.clock import Clock
from iort_agent.common.state import ClockOffset
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS

# A rule's timestamp() truncates to whole milliseconds.
_STAMP_MS = 0.5
# The drift of two oscillators. It makes an old narrow estimate worse than a new wide one.
_DRIFT_MS_PER_S = 0.05


class _Measured(NamedTuple):
    at: float
    cloud_minus_monotonic_ms: float
    half_trip_ms: float

    def uncertainty_ms(self, now: float) -> float:
        return self.half_trip_ms + _STAMP_MS + (now - self.at) * _DRIFT_MS_PER_S


class OffsetEstimator:
    """Keeps the best round trip so far. Safe to use from several threads."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._best: _Measured | None = None

    def add(self, sent: float, received: float, stamp_ms: int) -> None:
        """Take a round trip: the monotonic times of sending and receiving, and the cloud's stamp."""
        half_trip_ms = (received - sent) * 500
        new = _Measured(received, stamp_ms + _STAMP_MS - sent * 1000 - half_trip_ms, half_trip_ms)
        with self._lock:
            if self._best is None or _replaces(new, self._best):
                self._best = new

    def estimate(self) -> ClockOffset | None:
        """The offset now; None before the first round trip."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        wall_minus_monotonic_ms = self._clock.now_us() / 1000 - now * 1000
        return ClockOffset(
            round(best.cloud_minus_monotonic_ms - wall_minus_monotonic_ms, 3),
            round(best.uncertainty_ms(now), 3),
        )

    def known(self) -> ClockOffset | None:
        """The offset, if its uncertainty is at most `iort_contract.CLOCK_MAX_UNCERTAINTY_MS`."""
        found = self.estimate()
        return found if found is not None and found.uncertainty_ms <= CLOCK_MAX_UNCERTAINTY_MS else None

    def known_us(self) -> int | None:
        """The offset of `known` in microseconds, computed fast enough for every live message."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        if best.uncertainty_ms(now) > CLOCK_MAX_UNCERTAINTY_MS:
            return None
        return round((best.cloud_minus_monotonic_ms + now * 1000) * 1000) - self._clock.now_us()


def _replaces(new: _Measured, old: _Measured) -> bool:
    """Whether the new one is narrower now, or contradicts the old one: the computer slept, which stops its
    monotonic clock, or the cloud's clock was set."""
    apart_ms = abs(new.cloud_minus_monotonic_ms - old.cloud_minus_monotonic_ms)
    new_ms, old_ms = new.uncertainty_ms(new.at), old.uncertainty_ms(new.at)
    return new_ms <= old_ms or apart_ms > new_ms + old_ms
