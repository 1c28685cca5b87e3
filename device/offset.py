"""The cloud's clock against the car's, from pings through a rule, which stamps them on their way.

Cristian's method: the stamp was made between sending and receiving, so the middle of the two is wrong
by half the round trip at most. The offset is kept against the monotonic clock, so that it is right
again at once when the wall clock is set.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from device.clock import Clock

# timestamp() in a rule is whole milliseconds, cut off.
_STAMP_MS = 0.5
# Two oscillators drift apart by so much: an old narrow estimate becomes worse than a new wide one.
_DRIFT_MS_PER_S = 0.05
_KEPT = 100


class Offset(NamedTuple):
    """What to add to the car's clock to have the cloud's, and by how much that may be wrong."""

    offset_ms: float
    uncertainty_ms: float


class _Seen(NamedTuple):
    at: float
    cloud_minus_monotonic_ms: float
    half_trip_ms: float


class ClockOffset:
    """The estimate from the best of the newest round trips. Safe to use from several threads."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._seen: deque[_Seen] = deque(maxlen=_KEPT)

    def add(self, sent: float, received: float, stamp_ms: int) -> None:
        """Take a round trip: monotonic times of sending and receiving, and the cloud's stamp."""
        half_trip_ms = (received - sent) * 500
        cloud_ms = stamp_ms + _STAMP_MS
        with self._lock:
            self._seen.append(_Seen(received, cloud_ms - sent * 1000 - half_trip_ms, half_trip_ms))

    def estimate(self) -> Offset | None:
        """The offset now; None before the first round trip."""
        now = self._clock.monotonic()
        with self._lock:
            found = [(s.half_trip_ms + _STAMP_MS + (now - s.at) * _DRIFT_MS_PER_S, s) for s in self._seen]
        if not found:
            return None
        uncertainty_ms, best = min(found)
        wall_minus_monotonic_ms = self._clock.now_us() / 1000 - now * 1000
        return Offset(
            round(best.cloud_minus_monotonic_ms - wall_minus_monotonic_ms, 3), round(uncertainty_ms, 3)
        )
