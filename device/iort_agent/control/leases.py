"""Which commands may pass, and when the robot must be stopped: a state machine without clock or ROS.

A motion command is a promise of the operator to say something again soon. The lease is how long the
robot takes his word for it, from when he said it: a word that was long on its way, or waited in a robot
that was frozen, has that much less of it left, or none. When the lease ends unrenewed, a stop is due, and
is due again a few times, for a single message may find a node that is just starting. Then there is silence,
so that whoever drives the robot next (a joystick, a planner on board) is not held down for ever.

Only what is later than everything that has passed may pass. Commands are timed by the cloud's clock, and so
is their age, which the robot knows to within the uncertainty of its measured offset
(`iort_agent.lanes.clock_offset`): the oldest that a command may be is what counts.
 A robot that does not know what time it is in the cloud lets
nothing move it. Leases run on the clock that never jumps.
"""

from __future__ import annotations

from typing import NamedTuple

from iort_contract.messages.commands import Command

# A stop is said at once, and so many times more.
STOP_REPEATS = 4
STOP_REPEAT_S = 0.25

STALE, LEASE_OVER, EARLY, REPEATED, SUPERSEDED, NO_LEASE, CLOCK_UNKNOWN, CLOSED = (
    "stale",
    "lease_over",
    "from_the_future",
    "repeated_or_out_of_order",
    "from_an_earlier_session",
    "without_lease",
    "clock_offset_unknown",
    "shutting_down",
)


class Limits(NamedTuple):
    """What the robot allows, whatever a command asks for. ``lease_s`` is None where nothing moves."""

    max_age_s: float
    max_ahead_s: float
    lease_s: float | None = None


class Leases:
    """The commands of one name. Not safe to use from several threads at once."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._last: Command | None = None
        self._closed = False
        # When the motion that passed last ends, and the stops that are to be said.
        self._ends: float | None = None
        self._stops = 0
        self._next_stop = 0.0

    def offer(self, command: Command, *, now_us: int, wrong_us: int | None, now: float) -> str | None:
        """None if the command may pass, which counts as having passed; otherwise why not.

        ``now_us`` is the cloud's time, to within ``wrong_us``, or the robot's own where that is None.
        """
        age_us = now_us - command.sent_us + (wrong_us or 0)
        lease_s = self._lease_s(command, age_us)
        refusal = self._refusal(command, age_us, wrong_us, lease_s)
        if refusal is not None:
            return refusal
        self._last = command
        if lease_s is not None:
            self._ends = now + lease_s
            self._stops = 0
        return None

    def stop_due(self, now: float) -> bool:
        """Whether a stop must be published now; asking means that it is."""
        if self._ends is not None and now >= self._ends:
            self._ends = None
            self._stops, self._next_stop = STOP_REPEATS + 1, now
        if not self._stops or now < self._next_stop:
            return False
        self._stops -= 1
        self._next_stop = now + STOP_REPEAT_S
        return True

    def cut(self, now: float) -> None:
        """End the lease now: whoever gave it can no longer be heard."""
        if self._ends is not None:
            self._ends = now

    def close(self, now: float) -> None:
        """End the lease now, and let nothing pass any more."""
        self._closed = True
        self.cut(now)

    def next_due(self) -> float | None:
        """When `stop_due` should be asked next; None while there is nothing to stop."""
        if self._ends is not None:
            return self._ends
        return self._next_stop if self._stops else None

    def _lease_s(self, command: Command, age_us: int) -> float | None:
        """How long a motion may go on from now; None for what does not move."""
        if self._limits.lease_s is None or command.lease_ms is None:
            return None
        # A sender whose clock is ahead gets no more than one whose word arrives at once.
        return min(command.lease_ms / 1000, self._limits.lease_s) - max(0, age_us) / 1e6

    def _refusal(
        self, command: Command, age_us: int, wrong_us: int | None, lease_s: float | None
    ) -> str | None:
        limits, last = self._limits, self._last
        if self._closed:
            return CLOSED
        if limits.lease_s is not None and wrong_us is None:
            return CLOCK_UNKNOWN
        if age_us > min(command.valid_ms * 1000, limits.max_age_s * 1e6):
            return STALE
        if age_us < -limits.max_ahead_s * 1e6:
            return EARLY
        if limits.lease_s is not None and command.lease_ms is None:
            return NO_LEASE
        if lease_s is not None and lease_s <= 0:
            return LEASE_OVER
        if last is not None and command.order <= last.order:
            return REPEATED if command.session == last.session else SUPERSEDED
        return None
