"""A token bucket for each robot."""

from __future__ import annotations

import threading
from collections import OrderedDict

# Robots beyond this number have spent nothing worth keeping.
_ROBOTS = 10_000


class RateLimiter:
    """Each robot may spend ``burst`` at once, and ``a_second`` more with every second. Robots share nothing.

    It keeps the ten thousand robots that spent last. It is safe for several threads.
    """

    def __init__(self, *, burst: float, a_second: float) -> None:
        self._burst, self._a_second = burst, a_second
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def left(self, robot: str, now_s: float) -> float:
        """The robot's remaining allowance; negative after overspending."""
        left, at_s = self._left.get(robot, (self._burst, now_s))
        # A clock that is set back takes nothing away.
        return min(self._burst, left + self._a_second * max(0.0, now_s - at_s))

    def spend(self, robot: str, now_s: float, amount: float) -> float:
        """Spend an amount; return the rest."""
        with self._lock:
            left = self.left(robot, now_s) - amount
            # After a clock was set back, the same seconds must not count twice.
            _, at_s = self._left.get(robot, (0.0, now_s))
            self._left[robot] = (left, max(at_s, now_s))
            self._left.move_to_end(robot)
            if len(self._left) > _ROBOTS:
                self._left.popitem(last=False)
        return left
