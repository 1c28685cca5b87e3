"""A driver's hold of the stick, without terminal and network: when the car may move, which commands go out,
and why it is over.

A hold begins at a standstill. It may move the car once the car has answered a command, within the limits of
the round trip and of the newest sample's age. Whatever ends it, the driver must let go before the next one: a
car must not move because an obstacle to driving has gone away. A driver who has let go still has the wheel:
the car is told to stand, so that no planner on board drives off, until the driver leaves the wheel or loses
it.

    free -- hold --> starting -- the car answers --> driving -- let go --> holding -- hold --> starting
                         |                              |                     |
                         +--- something is against it --+--> over             +-- leave, lost --> free

A robot with video is driven by sight: each command names the newest picture on the driver's screen. Without
one, or with one that is older than the robot allows, nothing is sent but the end of the lease, also by a
driver who has let go: the car is lost as by a lease that ended. A driver may say to drive blind.

The page does the same in station/web/src/drive/driver.ts; tests/unit/station/fleet/driving.json tests both.

Times are microseconds of this computer's monotonic clock. The cloud's time is learned from the car's
messages, so this computer's own clock may be wrong."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NamedTuple

from iort_contract.catalog.streams import DRIVE_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages import commands
from iort_contract.messages.live import LiveSample
from iort_contract.topics import ACCEPTED

_ANSWER_US = commands.DRIVE_ANSWER_MS * 1000
# Between two samples of the stream `drive`, at most.
_SAMPLE_US = round(1e6 / LIVE_MAX_RATE_HZ)


class Phase(Enum):
    """Nobody holds; the car has not answered yet; the stick drives; the driver has let go, and the car is
    held at a standstill; over until the driver lets go."""

    FREE = "free"
    STARTING = "starting"
    DRIVING = "driving"
    HOLDING = "holding"
    OVER = "over"


class Stick(NamedTuple):
    """Where the stick is, from -1 to 1: forwards and to the left are positive."""

    speed: float = 0.0
    steering: float = 0.0


class CloudClock:
    """The cloud's time minus this clock's, between what two kinds of messages tell: one that the car sent,
    which was later heard here, and one that was sent here, which the car later took."""

    def __init__(self) -> None:
        self._least: list[tuple[int, int]] = []
        self._most: list[tuple[int, int]] = []

    def heard(self, sent_us: int, now_us: int) -> None:
        """Take the cloud's time at which a message was sent that is heard now."""
        self._least = _bounds(self._least, now_us, sent_us - now_us, max)

    def answered(self, left_us: int, taken_us: int) -> None:
        """Take the cloud's time at which the car took a command that left here."""
        self._most = _bounds(self._most, left_us, taken_us - left_us, min)

    def offset_us(self) -> int | None:
        """The cloud's time minus this clock's; None before the first message. Without an answer it is the
        least that it can be: a command seems older than it is, and its lease ends too early."""
        if not self._least:
            return None
        least = self._least[0][1]
        most = self._most[0][1] if self._most else least
        # They contradict each other once a clock was set, or this computer slept.
        return (least + most) // 2 if most > least else least


def _bounds(
    bounds: list[tuple[int, int]], at_us: int, offset_us: int, better: Callable[[int, int], int]
) -> list[tuple[int, int]]:
    """The bounds that are believed, the tightest first: a newer one replaces those that it betters."""
    young = [one for one in bounds if at_us - one[0] < commands.DRIVE_CLOCK_KEPT_MS * 1000]
    return [*(one for one in young if better(one[1], offset_us) != offset_us), (at_us, offset_us)]


class Driver:
    """One driver at one stick. ``top_mps`` is the driver's own top speed, within the car's limit;
    ``new_name`` names each session. ``picture_us`` is how old a picture may be; None for a robot without
    video. A driver of one with video sees its pictures (`see`), or is ``blind``."""

    def __init__(
        self,
        limits: commands.DriveLimits,
        by: str,
        top_mps: float,
        new_name: Callable[[], str] = lambda: secrets.token_hex(8),
        *,
        picture_us: int | None = None,
        blind: bool = False,
    ) -> None:
        self.limits, self.top_mps = limits, top_mps
        self.phase, self.reason, self.stick = Phase.FREE, "", Stick()
        self.rtt_us: int | None = None
        # Who drives, by the car's own word.
        self.driver = ""
        self.mine = False
        self.takeover = False
        self.by = by
        self.blind = blind
        self._new_name = new_name
        self._picture_us = picture_us
        # The newest picture on the screen, and when it was taken, by this clock.
        self._frame: int | None = None
        self._captured_us = 0
        # Whether the car is told to stand while nobody holds the stick.
        self._standing = False
        self._clock = CloudClock()
        self._clockless = False
        self._held = False
        self._session, self._started_us, self._seq = "", 0, 0
        self._began_us = self._driver_until_us = 0
        self._ticked_us: int | None = None
        self._corrections = self._stops = 0
        self._taken_us: int | None = None
        # When each command left that the car has not answered.
        self._waiting: dict[int, int] = {}

    def age_us(self, now_us: int) -> int | None:
        """The age of the car's newest sample; None before the first one."""
        offset_us = self._clock.offset_us()
        if offset_us is None or self._taken_us is None:
            return None
        return max(0, now_us + offset_us - self._taken_us)

    @property
    def unsighted(self) -> bool:
        """Whether a robot with video is driven without its picture."""
        return self.blind and self._picture_us is not None

    def see(self, frame: int | None, age_us: int, now_us: int) -> None:
        """Take the newest picture on the screen, and its age; None once no picture is shown."""
        self._frame, self._captured_us = frame, now_us - age_us

    def hold(self, *, held: bool, now_us: int) -> None:
        """The driver holds the stick, or lets go."""
        if held == self._held:
            return
        self._held = held
        if not held:
            if not self._standing:
                self._finish()
            self.phase, self.reason = Phase.HOLDING if self._standing else Phase.FREE, ""
            return
        self._corrections = 0
        against = self._against(now_us)
        if against:
            self.phase, self.reason = Phase.OVER, against
            return
        self._began_us = now_us
        if self._standing:
            # The session has the car already.
            self.phase, self.reason = Phase.STARTING, ""
        else:
            self._begin(now_us)

    def leave(self) -> None:
        """Leave the wheel: others may drive."""
        self._held = False
        self._finish()
        self.phase, self.reason = Phase.FREE, ""

    def hear(self, stream: str, live: LiveSample, now_us: int) -> None:
        """Take a live message of the car."""
        self._clockless = live.offset_us is None
        if live.offset_us is not None:
            self._clock.heard(live.sent_us + live.offset_us, now_us)
            self._taken_us = max(self._taken_us or 0, live.t_us + live.offset_us)
        if stream == DRIVE_STREAM:
            self._answer(live.sample, live, now_us)

    def tick(self, now_us: int) -> commands.Command | None:
        """The command to send now, if any; called `DRIVE_RATE_HZ` times a second."""
        still_us = now_us - (now_us if self._ticked_us is None else self._ticked_us)
        self._ticked_us = now_us
        if now_us > self._driver_until_us:
            self.driver, self.mine = "", False
        unseen = self._unseen(now_us)
        if unseen and (self._standing or self.phase in (Phase.STARTING, Phase.DRIVING)):
            self._end(unseen, lost=True)
        if self.phase in (Phase.STARTING, Phase.DRIVING):
            # The keys of that time may have been let go since.
            lease_us = _lease_ms(self.limits) * 1000
            frozen = f"this program stood still for {still_us // 1000} ms" if still_us > lease_us else ""
            against = frozen or self._against(now_us) or self._unanswered(now_us)
            if against:
                self._end(against)
        if self.phase is Phase.DRIVING:
            return self._command(self.stick, now_us)
        if self.phase is Phase.STARTING or self._standing:
            return self._command(Stick(), now_us)
        if not self._stops:
            return None
        self._stops -= 1
        return self._command(Stick(), now_us, ends=True)

    def _begin(self, now_us: int) -> None:
        self._session, self._started_us = self._new_name(), self._cloud_us(now_us)
        self._seq, self._waiting, self._stops, self.rtt_us = 0, {}, 0, None
        self.phase, self.reason = Phase.STARTING, ""

    def _end(self, reason: str, *, lost: bool = False) -> None:
        """End the hold; the driver must let go. A car that is ``lost`` to another or a stop is not held."""
        moves = self.phase in (Phase.STARTING, Phase.DRIVING)
        if lost or not self._standing:
            self._finish()
        if moves or (lost and self.phase is not Phase.FREE):
            self.phase, self.reason = Phase.OVER if self._held else Phase.FREE, reason
        self.takeover = False

    def _finish(self) -> None:
        """Give the car up, if this driver may have it."""
        if self._standing or self.phase in (Phase.STARTING, Phase.DRIVING):
            self._stops = commands.DRIVE_ENDS
        self._standing = self.takeover = False

    def _against(self, now_us: int) -> str:
        """Why the car must not be driven now."""
        if self._clockless:
            return commands.REFUSALS[commands.CLOCK_UNKNOWN]
        age_us = self.age_us(now_us)
        if age_us is None:
            return "nothing has been heard of the car yet"
        if age_us > commands.DRIVE_MAX_AGE_MS * 1000:
            return f"the newest sample is {age_us // 1000} ms old, {commands.DRIVE_MAX_AGE_MS} ms are allowed"
        return self._unseen(now_us)

    def _unseen(self, now_us: int) -> str:
        """Why the car must not be driven by its picture; empty if it may, has none, or is driven blind."""
        if self._picture_us is None or self.blind:
            return ""
        if self._frame is None:
            return "there is no picture"
        age_us = now_us - self._captured_us
        if age_us > self._picture_us:
            return f"the picture is {age_us // 1000} ms old, {self._picture_us // 1000} ms are allowed"
        return ""

    def _unanswered(self, now_us: int) -> str:
        if self.phase is Phase.STARTING:
            return "the car does not answer" if now_us - self._began_us > _ANSWER_US else ""
        waited_us = now_us - min(self._waiting.values(), default=now_us)
        return _slow(waited_us) if waited_us > commands.DRIVE_MAX_RTT_MS * 1000 + _SAMPLE_US else ""

    def _answer(self, told: Mapping[str, Any], live: LiveSample, now_us: int) -> None:
        driver = told.get("driver")
        self.driver = str(told.get("driver_by") or "somebody") if driver else ""
        self.mine = driver == self._session
        self._driver_until_us = now_us + _whole(told.get("lease_left_ms")) * 1000
        if told.get("session") != self._session:
            # Another's command has passed, so ours no longer do.
            if self._standing and driver and not self.mine:
                self._end(f"{self.driver} has taken over", lost=True)
            return
        seq, outcome = _whole(told.get("seq")), told.get("outcome")
        left_us = self._waiting.get(seq)
        self._waiting = {one: at_us for one, at_us in self._waiting.items() if one > seq}
        if left_us is not None:
            self.rtt_us = max(0, now_us - left_us - max(0, live.sent_us - live.t_us))
            if live.offset_us is not None:
                self._clock.answered(left_us, live.t_us + live.offset_us)
        moves = self.phase in (Phase.STARTING, Phase.DRIVING)
        if outcome == commands.STOPPED:
            if moves:
                self._end("the car was stopped")
        elif outcome != ACCEPTED:
            if self._standing or moves:
                self._refused(str(outcome), now_us)
        elif not moves:
            return
        elif self.rtt_us is not None and self.rtt_us > commands.DRIVE_MAX_RTT_MS * 1000:
            self._end(_slow(self.rtt_us))
        elif self.phase is Phase.STARTING:
            self.phase, self.takeover, self._standing = Phase.DRIVING, False, True

    def _refused(self, outcome: str, now_us: int) -> None:
        if outcome == commands.DRIVEN_BY_ANOTHER:
            has = "has taken over" if self._standing else "drives this car"
            self._end(f"{self.driver or 'somebody'} {has}", lost=True)
        elif outcome in commands.LOST:
            self._end(commands.REFUSALS.get(outcome, outcome), lost=True)
        elif self.phase is Phase.HOLDING:
            return  # the next command may pass
        elif (
            self.phase is Phase.STARTING
            and not self._standing
            and outcome in commands.UNTIMELY
            and self._corrections < commands.DRIVE_CORRECTIONS
        ):
            self._corrections += 1
            self._begin(now_us)
        else:
            self._end(commands.REFUSALS.get(outcome, outcome))

    def _command(self, stick: Stick, now_us: int, *, ends: bool = False) -> commands.Command:
        seq, limits = self._seq, self.limits
        self._seq += 1
        self._waiting[seq] = now_us
        kept_us = _ANSWER_US + commands.DRIVE_LEASE_MS * 1000
        self._waiting = {one: at_us for one, at_us in self._waiting.items() if now_us - at_us < kept_us}
        top_mps = min(self.top_mps, limits.max_speed_mps)
        lease_ms = max(1, _lease_ms(limits) - commands.DRIVE_MARGIN_MS)
        return commands.Command(
            session=self._session,
            started_us=self._started_us,
            seq=seq,
            sent_us=max(self._started_us, self._cloud_us(now_us)),
            valid_ms=lease_ms,
            message=limits.message(stick.speed * top_mps, stick.steering * limits.max_steering_rad),
            lease_ms=lease_ms,
            by=self.by,
            takeover=self.takeover,
            ends=ends,
            frame=None if self._picture_us is None else self._frame,
            blind=self.unsighted,
        )

    def _cloud_us(self, now_us: int) -> int:
        return now_us + (self._clock.offset_us() or 0)


def _lease_ms(limits: commands.DriveLimits) -> int:
    """How long a command holds the car at most."""
    return min(commands.DRIVE_LEASE_MS, limits.lease_ms)


def _slow(rtt_us: int) -> str:
    return f"the round trip takes {rtt_us // 1000} ms, {commands.DRIVE_MAX_RTT_MS} ms are allowed"


def _whole(value: Any) -> int:
    return value if type(value) is int else 0
