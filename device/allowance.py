"""What AWS IoT lets one connection send: 100 publishes and 512 KB a second.

AWS' client would delay everything beyond that, live messages too. So the agent keeps below it by
itself: the live lane and pings take their share without asking, the record lane waits for the rest.
"""

from __future__ import annotations

import threading

from device.clock import Clock

PUBLISHES_PER_S = 100
BYTES_PER_S = 512 * 1024
# Below the limit, because the two sides' seconds are not the same ones.
_SHARE = 0.95
# A window of messages may go at once after a pause; more only makes those behind it wait.
_BURST_S = 0.2
_NOTHING_S = 1e-6
# Fixed header, packet id and properties of a PUBLISH, at most.
_OVERHEAD_BYTES = 16


class Allowance:
    """Two token buckets shared by all who publish on one connection."""

    def __init__(
        self, clock: Clock, *, publishes_per_s: float = PUBLISHES_PER_S, bytes_per_s: float = BYTES_PER_S
    ) -> None:
        self._clock = clock
        self._rates = (publishes_per_s * _SHARE, bytes_per_s * _SHARE)
        self._full = (self._rates[0] * _BURST_S, self._rates[1] * _BURST_S)
        self._left = list(self._full)
        self._at = clock.monotonic()
        self._lock = threading.Lock()

    def spend(self, topic: str, payload: bytes) -> None:
        """Note a publish. It may overdraw, which the record lane then waits for."""
        with self._lock:
            self._refill()
            self._left[0] -= 1
            self._left[1] -= len(topic) + len(payload) + _OVERHEAD_BYTES

    def delay_s(self) -> float:
        """Seconds until the record lane may publish; 0 for at once."""
        with self._lock:
            self._refill()
            delay = max((1 - self._left[0]) / self._rates[0], -self._left[1] / self._rates[1])
        # Rounding leaves a rest that no waiting ends.
        return delay if delay > _NOTHING_S else 0.0

    def _refill(self) -> None:
        now = self._clock.monotonic()
        passed, self._at = now - self._at, now
        for i, rate in enumerate(self._rates):
            self._left[i] = min(self._full[i], self._left[i] + passed * rate)
