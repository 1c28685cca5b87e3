"""What each robot may spend: so much at once, and so much more with every second."""

from __future__ import annotations

import threading
from collections import OrderedDict

# Of the others, none has spent anything worth mentioning.
_ROBOTS = 10_000


class Allowances:
    """A robot may spend ``burst`` at once, and ``a_second`` more with every second that passes. None shares
    another's allowance.

    Kept are the ten thousand robots that spent something last. Several threads may spend.
    """

    def __init__(self, *, burst: float, a_second: float) -> None:
        self._burst, self._a_second = burst, a_second
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def left(self, robot: str, now_s: float) -> float:
        """What the robot may still spend; less than nothing where it spent more than it may."""
        left, at_s = self._left.get(robot, (self._burst, now_s))
        # A clock that is set back takes nothing away.
        return min(self._burst, left + self._a_second * max(0.0, now_s - at_s))

    def spend(self, robot: str, now_s: float, amount: float) -> float:
        """Note what the robot spent; what is left."""
        with self._lock:
            left = self.left(robot, now_s) - amount
            # Nor may a clock that was set back give twice.
            _, at_s = self._left.get(robot, (0.0, now_s))
            self._left[robot] = (left, max(at_s, now_s))
            self._left.move_to_end(robot)
            if len(self._left) > _ROBOTS:
                self._left.popitem(last=False)
        return left
