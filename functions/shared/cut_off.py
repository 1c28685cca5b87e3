"""Whose live messages are not looked at for a while: a robot's whose messages are refused over and over."""

from __future__ import annotations

from functions.shared.allowances import Allowances

# So many messages of a robot may be refused at once, and one more with every second that passes.
BURST = 20
A_SECOND = 1.0


class CutOff:
    """A robot's allowance of refused messages.

    A refused message costs a call to the queue, a good one does not. While a robot has used its allowance
    up, its messages, good or bad, are not looked at: about one a second still is, so that a robot that has
    been mended is seen again at once. No other robot's messages wait for it, and none shares its allowance.

    One environment of the function keeps one, and environments do not know of each other. So a robot is
    refused at most `A_SECOND` times as many messages a second as there are environments, and each of these
    loses no more time to it than that of one refusal a second.
    """

    def __init__(self) -> None:
        self._refusals = Allowances(burst=BURST, a_second=A_SECOND)

    def closed(self, robot: str, now_s: float) -> bool:
        """Whether the robot has used up its allowance."""
        return self._refusals.left(robot, now_s) < 1

    def refused(self, robot: str, now_s: float) -> bool:
        """Note a refused message; whether the robot's next ones are not looked at."""
        return self._refusals.spend(robot, now_s, 1) < 1
