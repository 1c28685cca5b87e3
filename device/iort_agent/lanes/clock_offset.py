"""The cloud's clock against the car's, from pings through a rule, which stamps them on their way.

Cristian's method: the stamp was made between sending and receiving, so the middle of the two is wrong
by half the round trip at most. The offset is kept against the monotonic clock, so that it is right
again at once when the wall clock is set.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

from iort_agent.clock import Clock
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS

# timestamp() in a rule is whole milliseconds, cut off.
_STAMP_MS = 0.5
# Two oscillators drift apart by so much: an old narrow estimate becomes worse than a new wide one.
_DRIFT_MS_PER_S = 0.05


class Offset(NamedTuple):
    """What to add to the car's clock to have the cloud's, and by how much that may be wrong."""

    offset_ms: float
    uncertainty_ms: float


class _Seen(NamedTuple):
    at: float
    cloud_minus_monotonic_ms: float
    half_trip_ms: float

    def uncertainty_ms(self, now: float) -> float:
        return self.half_trip_ms + _STAMP_MS + (now - self.at) * _DRIFT_MS_PER_S


class ClockOffset:
    """The estimate from the best round trip so far. Safe to use from several threads."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._best: _Seen | None = None

    def add(self, sent: float, received: float, stamp_ms: int) -> None:
        """Take a round trip: monotonic times of sending and receiving, and the cloud's stamp."""
        half_trip_ms = (received - sent) * 500
        seen = _Seen(received, stamp_ms + _STAMP_MS - sent * 1000 - half_trip_ms, half_trip_ms)
        with self._lock:
            if self._best is None or _replaces(seen, self._best):
                self._best = seen

    def estimate(self) -> Offset | None:
        """The offset now; None before the first round trip."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        wall_minus_monotonic_ms = self._clock.now_us() / 1000 - now * 1000
        return Offset(
            round(best.cloud_minus_monotonic_ms - wall_minus_monotonic_ms, 3),
            round(best.uncertainty_ms(now), 3),
        )

    def known(self) -> Offset | None:
        """The offset, if it is known well enough to judge by (`CLOCK_MAX_UNCERTAINTY_MS`)."""
        found = self.estimate()
        return found if found is not None and found.uncertainty_ms <= CLOCK_MAX_UNCERTAINTY_MS else None

    def known_us(self) -> int | None:
        """The offset of `known` in microseconds; every live message asks."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        if best.uncertainty_ms(now) > CLOCK_MAX_UNCERTAINTY_MS:
            return None
        return round((best.cloud_minus_monotonic_ms + now * 1000) * 1000) - self._clock.now_us()


def _replaces(new: _Seen, old: _Seen) -> bool:
    """Whether it is the narrower one now, or the old one cannot be right any more: a computer that slept
    stopped its monotonic clock, or the cloud's clock was set."""
    apart_ms = abs(new.cloud_minus_monotonic_ms - old.cloud_minus_monotonic_ms)
    new_ms, old_ms = new.uncertainty_ms(new.at), old.uncertainty_ms(new.at)
    return new_ms <= old_ms or apart_ms > new_ms + old_ms
