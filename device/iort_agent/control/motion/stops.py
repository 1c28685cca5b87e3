"""When a robot must be stopped. Knows neither clock nor ROS.

A motion holds until the end of its lease. Then a stop is due. It is repeated a few times, because a single
message may miss a node that is just starting. Then it ends, so that another driver (a joystick, a planner on
board) is not blocked for ever. An emergency stop is repeated for as long as it holds, so that it keeps its
place before other drivers of the topic.
"""

from __future__ import annotations

import math

# Repetitions of a stop after the first one.
STOP_REPEATS = 4
STOP_REPEAT_S = 0.25
# Between the stops of an emergency stop. A multiplexer that ranks drivers forgets one after some 200 ms.
STOP_HOLD_S = 0.1
# The agent ends a lease this much early. At its very end the guard publishes the stop, if the agent has not:
# two processes that publish at one moment are heard in any order, and a stop could seem to precede a motion.
STOP_AHEAD_MS = 30


class Stops:
    """The stops of one motion. Times are of the monotonic clock. Not for several threads at once."""

    def __init__(self) -> None:
        # The end of the current lease.
        self.ends: float | None = None
        # When the newest lease was over and the first stop was due.
        self.ended = -math.inf
        # Whether an emergency stop holds.
        self.held = False
        # The stops still to publish: infinitely many in an emergency stop.
        self._stops = 0.0
        self._next_stop = 0.0

    def move(self, until: float) -> None:
        """Begin a lease, or renew it; no stop is due before its end."""
        self.ends, self._stops = until, 0

    def expire(self, now: float) -> None:
        """Note the end of a lease that is over."""
        if self.ends is not None and now >= self.ends:
            self.ends, self.ended = None, now
            self._stops, self._next_stop = STOP_REPEATS + 1, now

    def stop_due(self, now: float) -> bool:
        """Whether the caller must publish a stop now."""
        self.expire(now)
        if not self._stops or now < self._next_stop:
            return False
        self._stops -= 1
        self._next_stop = now + (STOP_HOLD_S if self.held else STOP_REPEAT_S)
        return True

    def next_due(self) -> float | None:
        """When to call `stop_due` next; None while nothing moves."""
        if self.ends is not None:
            return self.ends
        return self._next_stop if self._stops else None

    def cut(self, now: float) -> None:
        """End the lease now: its sender cannot be heard any more."""
        if self.ends is not None:
            self.ends = now

    def hold(self, now: float) -> None:
        """End the lease, and repeat the stop until `free`."""
        if not self.held:
            self.held, self.ends = True, None
            self._stops, self._next_stop = math.inf, now

    def put_off(self, until: float) -> None:
        """Publish no stop of an emergency stop before then: somebody else does."""
        if self.held:
            self._next_stop = until

    def free(self) -> None:
        """Repeat the stop a few times more."""
        if self.held:
            self.held, self._stops = False, STOP_REPEATS
