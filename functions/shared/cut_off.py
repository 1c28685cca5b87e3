"""Skips live messages of robots that send too many malformed ones."""

from __future__ import annotations

from functions.shared.rate_limiter import RateLimiter

# Allowed refusals per robot: this many at once, and one more with every second.
BURST = 20
A_SECOND = 1.0


class CutOff:
    """A robot's allowance of refused messages.

    A refused message costs a call to the queue, a good one does not. While a robot's allowance is used up,
    its messages are skipped, good or bad. About one a second is still processed, so that a repaired robot is
    seen again at once. Other robots are not affected.

    Each environment of the function has its own allowances. So a robot can have at most `A_SECOND` refusals a
    second and environment, and costs each environment no more time than one refusal a second.
    """

    def __init__(self) -> None:
        self._refusals = RateLimiter(burst=BURST, a_second=A_SECOND)

    def closed(self, robot: str, now_s: float) -> bool:
        """Whether the robot has used up its allowance."""
        return self._refusals.left(robot, now_s) < 1

    def refused(self, robot: str, now_s: float) -> bool:
        """Count a refused message; return whether the robot's next messages are skipped."""
        return self._refusals.spend(robot, now_s, 1) < 1
