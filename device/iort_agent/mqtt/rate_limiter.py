"""AWS IoT's limits of one connection, 100 publishes and 512 KB a second, shared by all who publish on it.

The record lane goes first: `RateLimiter.expect` says what it needs, and all others share the rest. Nobody
publishes what would exceed the limit within the last second.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple, Tuple

from iort_agent.common.threads import Clock

PUBLISHES_PER_S = 100
BYTES_PER_S = 512 * 1024
# The share of the limit that is used in the long run. A message delayed on its way counts at the broker in
# the same second as those behind it.
SHARE = 0.9
# The burst allowed after a pause, in seconds' worth. A longer one would only delay the messages behind it.
_BURST_S = 0.04
# The same for the others' rest: they wait while batches go.
_REST_BURST_S = 1.0
# While a backlog drains, the others get at most this share, and at most half of what the record lane does not
# need for new batches: the backlog shrinks by the other half.
_DRAIN_SHARE = 0.1
# The others always get this share, even if more is recorded than can be sent: for a fault, a ping.
_LEAST_SHARE = 0.02
# Batches close together at the second's edge. A record lane that waits for longer than this drains a backlog.
_BUNCH_S = 1.0
# The record lane's thread may wake up this much later than it was told.
_LATE_S = 0.05
_WINDOW_S = 1.0
_ROUNDING = 1e-6
# Buckets are filled in steps of this length: a message asks first, and is charged when it is made.
_STEP_S = 1e-3
# Fixed header, packet id and properties of a PUBLISH, at most.
_OVERHEAD_BYTES = 16

# Publishes and bytes, of a second or in all.
Pair = Tuple[float, float]


class Priority(NamedTuple):
    """How a publisher other than the record lane may go: by how many seconds' worth it may overdraw, up to
    which share of the limit, and whether it gives way to waiting batches."""

    debt_s: float
    most: float
    yields: bool


LIVE = Priority(0.0, 0.96, yields=True)
# Messages at a steady rate that lose their value by waiting: pings, messages between robots.
STEADY = Priority(0.05, 0.96, yields=False)
# Rare messages that must not wait: another fault code.
URGENT = Priority(0.1, 0.99, yields=False)


class _Bucket:
    """Two token buckets, of publishes and of bytes. A message may go if both are above the allowed debt, and
    may take more than is left."""

    def __init__(self, rates: Pair, depth_s: float) -> None:
        self.rates = rates
        self._depth_s = depth_s
        self._left: Pair = (rates[0] * depth_s, rates[1] * depth_s)

    def refill(self, passed_s: float) -> None:
        publishes, payloads = self.rates
        self._left = (
            min(publishes * self._depth_s, self._left[0] + passed_s * publishes),
            min(payloads * self._depth_s, self._left[1] + passed_s * payloads),
        )

    def take(self, size: int) -> None:
        self._left = (self._left[0] - 1, self._left[1] - size)

    def debt_s(self) -> float:
        """Seconds until the bucket has no debt; below 0 if it has none."""
        return max(-self._left[0] / self.rates[0], -self._left[1] / self.rates[1])

    def covers(self, debt_s: float, rates: Pair) -> bool:
        """Whether its debt is at most so many seconds' worth of these rates."""
        publishes, payloads = self._left
        return publishes >= -rates[0] * debt_s - _ROUNDING and payloads >= -rates[1] * debt_s - _ROUNDING


class _LastSecond:
    """The publishes of the last second."""

    def __init__(self, limits: Pair) -> None:
        self._limits = limits
        self._sent: deque[tuple[float, int]] = deque()
        self._bytes = 0

    def add(self, now: float, size: int) -> None:
        self._sent.append((now, size))
        self._bytes += size

    def delay_s(self, now: float, size: int, most: float) -> float:
        """Seconds until it is worth asking again; 0 if a message of that size fits."""
        while self._sent and now - self._sent[0][0] >= _WINDOW_S:
            self._bytes -= self._sent.popleft()[1]
        publishes, payloads = self._limits[0] * most, self._limits[1] * most
        if not self._sent or (len(self._sent) < publishes and self._bytes + size <= payloads):
            return 0.0
        return self._sent[0][0] + _WINDOW_S - now


class RateLimiter:
    """The limits of one connection. Safe to use from several threads."""

    def __init__(
        self, clock: Clock, *, publishes_per_s: float = PUBLISHES_PER_S, bytes_per_s: float = BYTES_PER_S
    ) -> None:
        self._clock = clock
        # The long-run limits.
        self.rates: Pair = (publishes_per_s * SHARE, bytes_per_s * SHARE)
        self._second = _LastSecond((publishes_per_s, bytes_per_s))
        self._all = _Bucket(self.rates, _BURST_S)
        # The part of it that the record lane leaves to the others.
        self._rest = _Bucket(self.rates, _REST_BURST_S)
        self._need: Pair = (0.0, 0.0)
        self._backlog = False
        # Since when the record lane waits for its turn, and at least until when.
        self._waits_since = self._waits_until = float("-inf")
        self._at = clock.monotonic()
        self._lock = threading.Lock()

    def expect(self, need: Pair, *, backlog: bool) -> None:
        """Set what the record lane will need a second. ``backlog``: more waits than fits into a second."""
        with self._lock:
            self._need, self._backlog = need, backlog

    def record(self, topic: str, payload: bytes) -> float:
        """The record lane's turn: 0 if it may publish now, which is charged at once; else the seconds after
        which it asks again."""
        size = _size(topic, len(payload))
        with self._lock:
            now = self._refill()
            delay_s = max(self._all.debt_s(), self._second.delay_s(now, size, LIVE.most))
            if now > self._waits_until + _LATE_S:
                self._waits_since = now
            if delay_s > _ROUNDING:
                self._waits_until = now + delay_s + _LATE_S
                return delay_s
            self._waits_until = now
            self._all.take(size)
            self._second.add(now, size)
            return 0.0

    def may_go(self, priority: Priority, topic: str, payload_bytes: int) -> bool:
        """Whether a publisher other than the record lane may publish now; `spend` charges it."""
        with self._lock:
            now = self._refill()
            drains = self._drains(now)
            if priority.yields and not drains and now < self._waits_until:
                return False
            # While a backlog drains, the record lane always leaves a debt.
            debt_s = max(priority.debt_s, STEADY.debt_s) if drains else priority.debt_s
            return (
                self._all.covers(debt_s, self.rates)
                and self._rest.covers(priority.debt_s, self.rates)
                and self._second.delay_s(now, _size(topic, payload_bytes), priority.most) <= 0
            )

    def spend(self, topic: str, payload: bytes) -> None:
        """Charge a publish of anybody but the record lane."""
        size = _size(topic, len(payload))
        with self._lock:
            now = self._refill()
            self._all.take(size)
            self._rest.take(size)
            self._second.add(now, size)

    def _refill(self) -> float:
        now = self._clock.monotonic()
        passed_s = now - self._at
        if passed_s < _STEP_S:
            return now
        self._at = now
        self._all.refill(passed_s)
        drains = self._drains(now)
        rates, need = self.rates, self._need
        self._rest.rates = _rest(rates[0], need[0], drains=drains), _rest(rates[1], need[1], drains=drains)
        self._rest.refill(passed_s)
        return now

    def _drains(self, now: float) -> bool:
        return self._backlog or (now < self._waits_until and now - self._waits_since > _BUNCH_S)


def _rest(rate: float, need: float, *, drains: bool) -> float:
    """What the record lane leaves of a rate."""
    rest = rate - need
    if drains:
        rest = min(rate * _DRAIN_SHARE, rest / 2)
    return max(rest, rate * _LEAST_SHARE)


def _size(topic: str, payload_bytes: int) -> int:
    return len(topic) + payload_bytes + _OVERHEAD_BYTES
