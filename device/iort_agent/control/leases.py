"""Decides which commands may pass, and when the robot must be stopped. Knows neither clock nor ROS.

A motion command is valid for a lease, counted from when it was sent. A command that was long on its way, or
that waited in a frozen robot, has less of its lease left, or nothing. When the lease ends without a newer
command, a stop is due. It is repeated a few times, because a single message may miss a node that is just
starting. Then it ends, so that another driver (a joystick, a planner on board) is not blocked for ever.

Only a command later than all that passed may pass. Commands carry the cloud's time. The robot knows it to
within the uncertainty of its measured offset (`iort_agent.lanes.clock_offset`), and counts a command as old
as it may be. Without a known offset, no motion command passes. Leases run on the monotonic clock.
"""

from __future__ import annotations

from typing import NamedTuple

from iort_contract.messages.commands import Command

# Repetitions of a stop after the first one.
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
    """The robot's limits for all commands of a name. ``lease_s`` is None for commands that move nothing."""

    max_age_s: float
    max_ahead_s: float
    lease_s: float | None = None


class Leases:
    """The commands of one name. Not safe to use from several threads at once."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._last: Command | None = None
        self._closed = False
        # The end of the current lease, and the stops still to publish.
        self._ends: float | None = None
        self._stops = 0
        self._next_stop = 0.0

    def offer(self, command: Command, *, now_us: int, uncertainty_us: int | None, now: float) -> str | None:
        """None if the command may pass, and it counts as passed; otherwise the reason.

        ``now_us`` is the cloud's time to within ``uncertainty_us``; the robot's own time if that is None.
        """
        age_us = now_us - command.sent_us + (uncertainty_us or 0)
        lease_s = self._lease_s(command, age_us)
        reason = self._rejection(command, age_us, uncertainty_us, lease_s)
        if reason is not None:
            return reason
        self._last = command
        if lease_s is not None:
            self._ends = now + lease_s
            self._stops = 0
        return None

    def stop_due(self, now: float) -> bool:
        """Whether the caller must publish a stop now."""
        if self._ends is not None and now >= self._ends:
            self._ends = None
            self._stops, self._next_stop = STOP_REPEATS + 1, now
        if not self._stops or now < self._next_stop:
            return False
        self._stops -= 1
        self._next_stop = now + STOP_REPEAT_S
        return True

    def cut(self, now: float) -> None:
        """End the lease now: its sender cannot be heard any more."""
        if self._ends is not None:
            self._ends = now

    def close(self, now: float) -> None:
        """End the lease now, and let no further command pass."""
        self._closed = True
        self.cut(now)

    def next_due(self) -> float | None:
        """When to call `stop_due` next; None while nothing moves."""
        if self._ends is not None:
            return self._ends
        return self._next_stop if self._stops else None

    def _lease_s(self, command: Command, age_us: int) -> float | None:
        """The rest of the lease; None for a command that moves nothing."""
        if self._limits.lease_s is None or command.lease_ms is None:
            return None
        # A sender whose clock is ahead gets no more than the whole lease.
        return min(command.lease_ms / 1000, self._limits.lease_s) - max(0, age_us) / 1e6

    def _rejection(
        self, command: Command, age_us: int, uncertainty_us: int | None, lease_s: float | None
    ) -> str | None:
        limits, last = self._limits, self._last
        if self._closed:
            return CLOSED
        if limits.lease_s is not None and uncertainty_us is None:
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
