"""Decides which commands may pass and when the robot must be stopped. Knows neither clock nor ROS.

A motion command is valid for a lease, counted from when it was sent. A command that was long on its way, or
that waited in a frozen robot, has less of its lease left, or nothing. `STOP_AHEAD_MS` before the lease ends
without a newer command, a stop is due. It is repeated a few times, because a single message may miss a node
that is just starting. Then it ends, so that another driver (a joystick, a planner on board) is not blocked
for ever. An emergency stop is repeated for as long as it holds, so that it keeps its place before other
drivers of the topic.

```
          a motion passes                    the lease ends, or is cut
    still ───────────────► moving (lease) ──────────────────────────► stops, STOP_REPEATS more ──► still
      │                      │ ▲                                         │              ▲
      │                      │ └──────────── a newer motion ─────────────┘              │ free
      └──────── hold ────────┴───────────────── hold ──────────► held: stops for ever ──┘
```

One session drives at a time: while its lease holds, another one is refused unless it takes over. A session
that was refused so, or that an emergency stop ended, stays refused: a stick that is still held must not move
the robot at the moment when the other driver lets go, or when the stop is released.

What a session has sent before its lease ended moves nothing after the stop, even if it came late and its own
lease still holds.

A robot with video is driven by sight: a motion passes only if the picture that its driver saw is young enough
when it comes, or if he says that he drives blind. One that ends the lease always passes, and the robot gets
its stop in place of the message. This is asked last, so that an emergency stop, another driver or an old
command is told as what it is, and a late picture takes nothing over.

Only a command later than all that passed may pass. Commands carry the cloud's time. The robot knows it to
within the uncertainty of its measured offset (`iort_agent.lanes.pings`), and counts a command as old
as it may be. Without a known offset, no motion command passes. Leases run on the monotonic clock.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from iort_contract.messages.commands import (
    BEGIN_AGAIN,
    CLOCK_UNKNOWN,
    CLOSED,
    DRIVEN_BY_ANOTHER,
    EARLY,
    EMERGENCY_STOP,
    LEASE_OVER,
    NO_LEASE,
    NO_PICTURE,
    PICTURE_LATE,
    REPEATED,
    STALE,
    SUPERSEDED,
    Command,
)

# Repetitions of a stop after the first one.
STOP_REPEATS = 4
STOP_REPEAT_S = 0.25
# Between the stops of an emergency stop. A multiplexer that ranks drivers forgets one after some 200 ms.
STOP_HOLD_S = 0.1
# The agent ends a lease this much early. At its very end the guard publishes the stop, if the agent has not:
# two processes that publish at one moment are heard in any order, and a stop could seem to precede a motion.
STOP_AHEAD_MS = 30
# Refused sessions to remember.
_MAX_REFUSED = 64


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
            # Whoever moves it next has sent that after the stop.
            self.held, self.ends, self.ended = True, None, now
            self._stops, self._next_stop = math.inf, now

    def put_off(self, until: float) -> None:
        """Publish no stop of an emergency stop before then: somebody else does."""
        if self.held:
            self._next_stop = until

    def free(self) -> None:
        """Repeat the stop a few times more."""
        if self.held:
            self.held, self._stops = False, STOP_REPEATS


class Limits(NamedTuple):
    """The robot's limits for all commands of a name. ``lease_s`` is None for commands that move nothing,
    ``picture_ms`` for a robot without video."""

    max_age_s: float
    max_ahead_s: float
    lease_s: float | None = None
    picture_ms: float | None = None


class Leases(Stops):
    """The commands that move the robot by one ROS topic, or those of one name that move nothing. Not safe to
    use from several threads at once."""

    def __init__(self) -> None:
        super().__init__()
        # The newest command that passed.
        self.last: Command | None = None
        self._refused: deque[str] = deque(maxlen=_MAX_REFUSED)
        self._closed = False

    def offer(
        self,
        command: Command,
        limits: Limits,
        *,
        now_us: int,
        uncertainty_us: int | None,
        now: float,
        picture_ms: float | None = None,
    ) -> str | None:
        """None if the command may pass, and it counts as passed; otherwise the reason.

        ``limits`` are those of the command's name. ``now_us`` is the cloud's time to within
        ``uncertainty_us``; the robot's own time if that is None. ``picture_ms`` is the age of the picture
        that the command names; None if there is none, or the robot does not know it.
        """
        # In an agent that was frozen, a command may come before the stop.
        self.expire(now)
        age_us = now_us - command.sent_us + (uncertainty_us or 0)
        lease_s = _lease_s(command, limits, age_us)
        reason = self._rejection(command, limits, age_us, uncertainty_us, lease_s)
        if reason is None and lease_s is not None:
            reason = (
                self._other_driver(command, now)
                or self._stopped_since(command, age_us, now)
                or _unseen(command, limits, picture_ms)
            )
        if reason is not None:
            return reason
        self.last = command
        if lease_s is not None:
            self.move(now if command.ends else now + lease_s)
        return None

    def why_stopped(self) -> str:
        """Why a stop begins, for a person."""
        if self.held:
            return "emergency stop"
        return "the agent ends" if self._closed else "nobody renews it"

    def driver(self, now: float) -> Command | None:
        """The newest command of the session that drives now."""
        return self.last if self.left_s(now) else None

    def left_s(self, now: float) -> float:
        """How long the lease still holds."""
        return max(0.0, self.ends - now) if self.ends is not None else 0.0

    def hold(self, now: float) -> None:
        """The emergency stop: end the lease and its session, and repeat the stop until `free`."""
        if self._closed:
            return
        if self.last is not None:
            self._refuse(self.last.session)
        super().hold(now)

    def close(self, now: float, *, free: bool = True) -> None:
        """End the lease now, and let no further command pass; ``free`` also ends an emergency stop."""
        if free:
            self.free()
        self._closed = True
        self.cut(now)

    def _refuse(self, session: str) -> None:
        # Those that try on are remembered longest.
        if session in self._refused:
            self._refused.remove(session)
        self._refused.append(session)

    def _other_driver(self, command: Command, now: float) -> str | None:
        """Why a motion that is in time may not pass beside another driver or an emergency stop."""
        driver = self.driver(now)
        reason = None
        if self.held:
            reason = EMERGENCY_STOP
        elif driver is not None and driver.session != command.session and not command.takeover:
            reason = DRIVEN_BY_ANOTHER
        elif command.session in self._refused:
            reason = BEGIN_AGAIN
        if reason is not None:
            self._refuse(command.session)
        return reason

    def _stopped_since(self, command: Command, age_us: int, now: float) -> str | None:
        """Why a motion may not pass that its session sent before the robot was stopped: it would jerk."""
        same = self.last is not None and self.last.session == command.session
        return LEASE_OVER if same and not command.ends and now - age_us / 1e6 < self.ended else None

    def _rejection(
        self,
        command: Command,
        limits: Limits,
        age_us: int,
        uncertainty_us: int | None,
        lease_s: float | None,
    ) -> str | None:
        last = self.last
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


def _unseen(command: Command, limits: Limits, picture_ms: float | None) -> str | None:
    """Why a motion may not pass by what its driver saw."""
    if limits.picture_ms is None or command.blind or command.ends:
        return None
    if command.frame is None:
        return NO_PICTURE
    return None if picture_ms is not None and picture_ms <= limits.picture_ms else PICTURE_LATE


def _lease_s(command: Command, limits: Limits, age_us: int) -> float | None:
    """The rest of the lease for the agent; None for a command that moves nothing."""
    if limits.lease_s is None or command.lease_ms is None:
        return None
    # A sender whose clock is ahead gets no more than the whole lease.
    lease_ms = min(command.lease_ms, limits.lease_s * 1000) - STOP_AHEAD_MS
    return lease_ms / 1000 - max(0, age_us) / 1e6
