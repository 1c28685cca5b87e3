"""What AWS IoT lets one connection send: 100 publishes and 512 KB a second, and who of us gets it.

The record lane goes first. What it needs is known from how much is recorded (`expect`); everybody else
shares the rest. Nobody publishes where that would exceed the limit in the second that ends now.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple, Tuple

from iort_agent.clock import Clock

PUBLISHES_PER_S = 100
BYTES_PER_S = 512 * 1024
# What all of us send in the long run, of the limit: a message that was late on its way shares its second
# at the broker with those behind it.
SHARE = 0.9
# So many seconds' worth may go at once after a pause; more only makes those behind it wait.
_BURST_S = 0.04
# The others' rest is kept for so long, since they wait while batches go.
_KEPT_S = 1.0
# While a backlog drains, the others may have so much of everything, but no more than half of what the
# record lane does not need for the present: the other half is what the backlog shrinks by.
_DRAIN_SHARE = 0.1
# The least that the others have, where more is recorded than may be sent: a fault, the clock's offset.
_LEAST_SHARE = 0.02
# Batches close together at the second's edge, and the live lane waits for them. A record lane that waits
# for longer than this is draining a backlog.
_BUNCH_S = 1.0
# The record lane's thread may come a little later than it was told.
_LATE_S = 0.05
_WINDOW_S = 1.0
_NOTHING_S = 1e-6
# Fixed header, packet id and properties of a PUBLISH, at most.
_OVERHEAD_BYTES = 16

Pair = Tuple[float, float]


class Claim(NamedTuple):
    """How somebody beside the record lane may publish: by how many seconds' worth it may overdraw, up to
    which share of the limit, and whether it waits for batches that wait themselves."""

    debt_s: float
    most: float
    waits: bool


LIVE = Claim(0.0, 0.96, waits=True)
# What is sent at a steady rate, and is wrong or worth less when it waits: pings, messages between robots.
STEADY = Claim(0.05, 0.96, waits=False)
# What is rare and must not wait: another fault code.
URGENT = Claim(0.1, 0.99, waits=False)


class _Bucket:
    """Two token buckets, of publishes and of bytes. Who finds them not below zero may take, even more than
    there is."""

    def __init__(self, rates: Pair, depth_s: float) -> None:
        self.rates = rates
        self._depth_s = depth_s
        self._left = [rate * depth_s for rate in rates]

    def refill(self, passed_s: float) -> None:
        for i, rate in enumerate(self.rates):
            self._left[i] = min(rate * self._depth_s, self._left[i] + passed_s * rate)

    def take(self, size: int) -> None:
        self._left[0] -= 1
        self._left[1] -= size

    def delay_s(self) -> float:
        """Seconds until it is not below zero."""
        return max(-left / rate for left, rate in zip(self._left, self.rates))

    def covers(self, debt: Pair) -> bool:
        """Whether no more than that is owed."""
        return all(left >= -owed - _NOTHING_S for left, owed in zip(self._left, debt))


class _Second:
    """What was published within the second that ends now."""

    def __init__(self, limits: Pair) -> None:
        self._limits = limits
        self._went: deque[tuple[float, int]] = deque()
        self._bytes = 0

    def add(self, now: float, size: int) -> None:
        self._went.append((now, size))
        self._bytes += size

    def delay_s(self, now: float, size: int, most: float) -> float:
        """Seconds to wait before it is worth asking again; 0 where a message of that size fits."""
        while self._went and now - self._went[0][0] >= _WINDOW_S:
            self._bytes -= self._went.popleft()[1]
        publishes, payloads = self._limits[0] * most, self._limits[1] * most
        if not self._went or (len(self._went) < publishes and self._bytes + size <= payloads):
            return 0.0
        return self._went[0][0] + _WINDOW_S - now


class RateLimiter:
    """The limits of one connection, shared by all who publish on it."""

    def __init__(
        self, clock: Clock, *, publishes_per_s: float = PUBLISHES_PER_S, bytes_per_s: float = BYTES_PER_S
    ) -> None:
        self._clock = clock
        # What may be sent in the long run: publishes a second and bytes a second.
        self.rates: Pair = (publishes_per_s * SHARE, bytes_per_s * SHARE)
        self._second = _Second((publishes_per_s, bytes_per_s))
        self._all = _Bucket(self.rates, _BURST_S)
        # Which part of it is not the record lane's.
        self._rest = _Bucket(self.rates, _KEPT_S)
        self._need: Pair = (0.0, 0.0)
        self._backlog = False
        # Since when, and until when at least, the record lane waits for its turn.
        self._waits_since = self._waits_until = float("-inf")
        self._at = clock.monotonic()
        self._lock = threading.Lock()

    def expect(self, need: Pair, *, backlog: bool) -> None:
        """What the record lane will need: publishes and bytes a second. ``backlog``: it has more to send
        than fits into a second."""
        with self._lock:
            self._need, self._backlog = need, backlog

    def record(self, topic: str, payload: bytes) -> float:
        """The record lane's turn: 0 where it may publish this now, which counts as done; otherwise the
        seconds after which it asks again."""
        size = _size(topic, len(payload))
        with self._lock:
            now = self._refill()
            delay_s = max(self._all.delay_s(), self._second.delay_s(now, size, LIVE.most))
            if now > self._waits_until + _LATE_S:
                self._waits_since = now
            # Rounding leaves a rest that no waiting ends.
            if delay_s > _NOTHING_S:
                self._waits_until = now + delay_s + _LATE_S
                return delay_s
            self._waits_until = now
            self._all.take(size)
            self._second.add(now, size)
            return 0.0

    def may_go(self, claim: Claim, topic: str, payload_bytes: int) -> bool:
        """Whether somebody beside the record lane may publish now."""
        with self._lock:
            now = self._refill()
            drains = self._drains(now)
            if claim.waits and not drains and now < self._waits_until:
                return False
            # While a backlog drains, the record lane takes whatever is not owed already.
            debt_s = max(claim.debt_s, STEADY.debt_s) if drains else claim.debt_s
            return (
                self._all.covers(self._of_all(debt_s))
                and self._rest.covers(self._of_all(claim.debt_s))
                and self._second.delay_s(now, _size(topic, payload_bytes), claim.most) <= 0
            )

    def spend(self, topic: str, payload: bytes) -> None:
        """Note a publish of anybody beside the record lane: after `may_go`, or because it is rare."""
        size = _size(topic, len(payload))
        with self._lock:
            now = self._refill()
            for bucket in (self._all, self._rest):
                bucket.take(size)
            self._second.add(now, size)

    def _refill(self) -> float:
        now = self._clock.monotonic()
        passed_s, self._at = now - self._at, now
        self._all.refill(passed_s)
        drains = self._drains(now)
        self._rest.rates = (self._rest_of(0, drains=drains), self._rest_of(1, drains=drains))
        self._rest.refill(passed_s)
        return now

    def _drains(self, now: float) -> bool:
        return self._backlog or (now < self._waits_until and now - self._waits_since > _BUNCH_S)

    def _rest_of(self, i: int, *, drains: bool) -> float:
        rate = self.rates[i]
        rest = rate - self._need[i]
        if drains:
            rest = min(rate * _DRAIN_SHARE, rest / 2)
        return max(rest, rate * _LEAST_SHARE)

    def _of_all(self, seconds: float) -> Pair:
        return (self.rates[0] * seconds, self.rates[1] * seconds)


def _size(topic: str, payload_bytes: int) -> int:
    return len(topic) + payload_bytes + _OVERHEAD_BYTES
