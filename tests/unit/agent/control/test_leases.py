"""Which commands pass and when the robot stops, for any order of events."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iort_agent.control.leases import STOP_AHEAD_MS, STOP_HOLD_S, STOP_REPEAT_S, STOP_REPEATS, Leases, Limits
from iort_contract.messages.control.commands import Command
from iort_contract.messages.control.driving import (
    BEGIN_AGAIN,
    CLOSED,
    DRIVEN_BY_ANOTHER,
    EARLY,
    EMERGENCY_STOP,
    LEASE_OVER,
    NO_LEASE,
    REPEATED,
    STALE,
    SUPERSEDED,
)

T0 = 1_700_000_000_000_000
# A lease ends early for the agent: here after 0.5 s, that of a command after 0.3 s.
LIMITS = Limits(max_age_s=1.0, max_ahead_s=0.5, lease_s=0.5 + STOP_AHEAD_MS / 1000)


def command(seq: int = 0, **changes: Any) -> Command:
    settings: dict[str, Any] = {
        "session": "0badcafe",
        "started_us": T0 - 1_000_000,
        "sent_us": T0,
        "valid_ms": 800,
    }
    return Command(**{**settings, "seq": seq, "message": {}, "lease_ms": 300 + STOP_AHEAD_MS, **changes})


@pytest.mark.parametrize(
    ("changes", "refusal"),
    [
        ({}, None),
        ({"sent_us": T0 - 299_999}, None),
        ({"sent_us": T0 - 300_000}, LEASE_OVER),
        ({"sent_us": T0 - 499_999, "lease_ms": 10_000}, None),
        ({"sent_us": T0 - 500_000, "lease_ms": 10_000}, LEASE_OVER),
        ({"sent_us": T0 - 800_001}, STALE),
        ({"sent_us": T0 - 1_000_001, "valid_ms": 60_000}, STALE),
        ({"sent_us": T0 + 500_000}, None),
        ({"sent_us": T0 + 500_001}, EARLY),
        ({"lease_ms": None}, NO_LEASE),
    ],
)
def test_a_single_command(changes: dict[str, Any], refusal: str | None) -> None:
    assert Leases().offer(command(**changes), LIMITS, now_us=T0, uncertainty_us=0, now=0) == refusal


def test_only_a_later_command_passes() -> None:
    leases = Leases()
    later, earlier = (
        {"started_us": T0, "session": "1badcafe", "takeover": True},
        {"started_us": T0 - 1_000_000},
    )
    offers: list[tuple[int, dict[str, Any], str | None]] = [
        (5, earlier, None),
        (5, earlier, REPEATED),
        (4, earlier, REPEATED),
        (7, earlier, None),
        (0, later, None),
        (8, earlier, SUPERSEDED),
        (1, later, None),
    ]
    for seq, session, refusal in offers:
        assert leases.offer(command(seq, **session), LIMITS, now_us=T0, uncertainty_us=0, now=0) == refusal


def offered(leases: Leases, session: str, now: float = 0.0, **changes: Any) -> str | None:
    started_us = T0 - 1_000_000 + int(session[0], 16)
    one = command(session=session, started_us=started_us, sent_us=T0 + round(now * 1e6), **changes)
    return leases.offer(one, LIMITS, now_us=T0 + round(now * 1e6), uncertainty_us=0, now=now)


A, B, C = "aaaaaaaa", "bbbbbbbb", "cccccccc"


def test_one_session_drives_until_another_takes_over() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    assert offered(leases, B, seq=0) == DRIVEN_BY_ANOTHER
    assert offered(leases, C, seq=0, takeover=True) is None
    assert offered(leases, A, seq=1) == SUPERSEDED
    driver = leases.driver(0.2)
    assert (driver.session if driver else None, leases.left_s(0.2)) == (C, pytest.approx(0.1))
    assert leases.driver(0.3) is None


def test_a_stick_held_while_another_drove_moves_nothing_when_that_one_lets_go() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    assert offered(leases, B, seq=0) == DRIVEN_BY_ANOTHER
    assert offered(leases, B, 0.4, seq=1) == BEGIN_AGAIN
    assert offered(leases, B, 0.4, seq=2, takeover=True) == BEGIN_AGAIN
    assert offered(leases, C, 0.4, seq=0) is None, "the next press of the same driver"


def test_a_motion_that_ends_its_lease_stops_the_robot_and_lets_others_drive() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    assert offered(leases, A, 0.1, seq=1, ends=True) is None
    assert leases.driver(0.1) is None
    assert offered(leases, B, 0.1, seq=0) is None
    assert offered(leases, A, 0.1, seq=2, ends=True) == SUPERSEDED
    assert not leases.stop_due(0.1)


def test_an_emergency_stop_holds_until_it_is_released_and_ends_every_session() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    leases.hold(0.1)
    assert leases.driver(0.1) is None
    assert len(stops(leases, 0.95)) == pytest.approx(0.85 / STOP_HOLD_S, abs=1)
    assert offered(leases, A, 1.0, seq=1) == EMERGENCY_STOP
    assert offered(leases, B, 1.0, seq=0, takeover=True) == EMERGENCY_STOP
    leases.free()
    assert offered(leases, A, 1.1, seq=2) == BEGIN_AGAIN
    assert offered(leases, B, 1.1, seq=1, takeover=True) == BEGIN_AGAIN
    assert offered(leases, C, 1.2, seq=0) is None


def test_a_stick_that_is_held_is_refused_however_many_others_try() -> None:
    leases = Leases()
    leases.hold(0.0)
    for i in range(200):
        assert offered(leases, A, 0.1, seq=i) == EMERGENCY_STOP
        assert offered(leases, f"{i:08x}", 0.1, seq=0) == EMERGENCY_STOP
    leases.free()
    assert offered(leases, A, 0.2, seq=200) == BEGIN_AGAIN


def test_a_released_emergency_stop_ends_after_a_few_stops_and_so_does_a_closed_one() -> None:
    for end in (Leases.free, lambda leases: leases.close(0.0)):
        leases = Leases()
        leases.hold(0.0)
        assert leases.stop_due(0.0)
        end(leases)
        assert len(stops(leases, 10)) == STOP_REPEATS
        assert leases.next_due() is None


def test_a_command_without_motion_needs_no_lease_and_no_stop() -> None:
    leases = Leases()
    assert leases.offer(command(lease_ms=None), Limits(1.0, 0.5), now_us=T0, uncertainty_us=0, now=0) is None
    assert leases.next_due() is None
    assert not leases.stop_due(1e9)


def stops(leases: Leases, until: float, step: float = 0.01) -> list[float]:
    return [round(i * step, 3) for i in range(round(until / step) + 1) if leases.stop_due(i * step)]


def test_the_end_of_a_lease_repeats_the_stop_a_few_times() -> None:
    leases = Leases()
    leases.offer(command(), LIMITS, now_us=T0, uncertainty_us=0, now=0)
    assert stops(leases, 10) == [round(0.3 + i * STOP_REPEAT_S, 3) for i in range(STOP_REPEATS + 1)]
    assert leases.next_due() is None


def test_the_robots_own_limit_is_the_shorter_one() -> None:
    leases = Leases()
    leases.offer(command(lease_ms=10_000), LIMITS, now_us=T0, uncertainty_us=0, now=0)
    assert leases.next_due() == pytest.approx(0.5)


@pytest.mark.parametrize(("age_us", "uncertainty_us"), [(200_000, 0), (50_000, 150_000), (0, 200_000)])
def test_the_lease_runs_from_when_the_command_may_have_been_sent(age_us: int, uncertainty_us: int) -> None:
    leases = Leases()
    assert (
        leases.offer(command(sent_us=T0 - age_us), LIMITS, now_us=T0, uncertainty_us=uncertainty_us, now=7)
        is None
    )
    assert leases.next_due() == pytest.approx(7.1)


def test_a_sender_whose_clock_is_ahead_gets_no_longer_lease() -> None:
    leases = Leases()
    assert leases.offer(command(sent_us=T0 + 500_000), LIMITS, now_us=T0, uncertainty_us=0, now=7) is None
    assert leases.next_due() == pytest.approx(7.3)


def test_a_renewed_lease_has_no_stop() -> None:
    leases = Leases()
    for i in range(10):
        assert leases.offer(command(i), LIMITS, now_us=T0, uncertainty_us=0, now=i * 0.29) is None
        assert not leases.stop_due(i * 0.29 + 0.28)


def test_a_newer_command_ends_the_stops() -> None:
    leases = Leases()
    leases.offer(command(), LIMITS, now_us=T0, uncertainty_us=0, now=0)
    assert leases.stop_due(0.3)
    assert leases.offer(command(1), LIMITS, now_us=T0, uncertainty_us=0, now=0.4) is None
    assert not leases.stop_due(0.6)


def test_what_a_session_sent_before_the_stop_moves_nothing_after_it() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    assert leases.stop_due(0.3)
    # It was long on its way: for 0.2 s, and for 0.05 s.
    late, soon = (
        command(seq, session=A, started_us=T0, sent_us=T0 + at) for seq, at in ((1, 150_000), (2, 300_000))
    )
    times = {"now_us": T0 + 350_000, "uncertainty_us": 0, "now": 0.35}
    assert leases.offer(late, LIMITS, **times) == LEASE_OVER
    assert leases.offer(soon, LIMITS, **times) is None


def test_a_command_that_waited_in_a_frozen_agent_beside_the_stop_moves_nothing() -> None:
    leases = Leases()
    assert offered(leases, A, seq=0) is None
    waited = command(1, session=A, started_us=T0, sent_us=T0 + 150_000)
    times = {"now_us": T0 + 350_000, "uncertainty_us": 0, "now": 0.35}
    assert leases.offer(waited, LIMITS, **times) == LEASE_OVER
    assert leases.stop_due(0.35)


def test_cut_and_closed() -> None:
    leases = Leases()
    leases.cut(0)
    assert leases.next_due() is None, "nothing moved"
    leases.offer(command(), LIMITS, now_us=T0, uncertainty_us=0, now=0)
    leases.cut(0.1)
    assert leases.stop_due(0.1)
    leases.offer(command(1), LIMITS, now_us=T0, uncertainty_us=0, now=0.2)
    leases.close(0.25)
    assert leases.stop_due(0.25)
    assert leases.offer(command(2), LIMITS, now_us=T0, uncertainty_us=0, now=0.3) == CLOSED


# Any sequence of events of an operator, a network and a clock.

COMMANDS = st.builds(
    command,
    seq=st.integers(0, 6),
    session=st.sampled_from(["0badcafe", "1badcafe"]),
    started_us=st.sampled_from([T0 - 1_000_000, T0 - 2_000_000]),
    takeover=st.booleans(),
    sent_us=st.integers(T0 - 3_000_000, T0 + 3_000_000),
    valid_ms=st.integers(1, 3000),
    lease_ms=st.one_of(st.none(), st.integers(1, 2000)),
)
EVENTS = st.lists(
    st.one_of(
        COMMANDS,
        st.floats(0, 1, allow_nan=False),  # time passes
        st.sampled_from(["cut", "close", "back", "forth", "hold", "free"]),  # the wall clock may jump
        # The uncertainty of the clock offset from now on.
        st.tuples(st.one_of(st.none(), st.integers(0, 500_000))),
    ),
    max_size=60,
)
TICK = 0.05


def left_s(motion: Command, latest_us: int) -> float:
    """The rest of a lease, at the latest time that it may be."""
    assert motion.lease_ms is not None
    left = min((motion.lease_ms - STOP_AHEAD_MS) / 1000, 0.5) - max(0, latest_us - motion.sent_us) / 1e6
    assert left > 0, "what has no time left does not move"
    return left


class Model:
    """The leases, and what must be true of them."""

    def __init__(self) -> None:
        self.leases = Leases()
        self.now, self.offset_us = 0.0, 0
        self.uncertainty_us: int | None = 0
        self.closed = self.held = False
        self.passed: list[Command] = []
        self.refused: set[str] = set()  # sessions that an emergency stop ended
        self.moving_until: float | None = None  # the last motion's end
        self.stopped = -1e9  # when the last motion ended

    def tick(self) -> None:
        due = self.leases.next_due()
        said = self.leases.stop_due(self.now)
        assert said == (due is not None and due <= self.now)
        assert due is not None or not self.held, "an emergency stop goes on"
        if self.moving_until is not None and self.now >= self.moving_until:
            assert said, "a stop follows the last motion by the first tick after its lease"
            self.moving_until, self.stopped = None, self.now
        elif said:
            assert self.moving_until is None, "nothing stops a motion whose lease holds"

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, self.now + TICK)
            self.tick()

    def end(self, how: str) -> None:
        if how == "hold":
            self.leases.hold(self.now)
            if not self.closed:
                self.held = True
                self.refused |= {one.session for one in self.passed[-1:]}
        else:
            (self.leases.close if how == "close" else self.leases.cut)(self.now)
            self.closed = self.closed or how == "close"
            self.held = self.held and not self.closed
        if self.moving_until is not None:
            self.moving_until = min(self.moving_until, self.now)
        self.tick()

    def free(self) -> None:
        self.leases.free()
        self.held = False

    def offer(self, event: Command) -> None:
        now_us = T0 + round(self.now * 1e6) + self.offset_us
        uncertainty_us = self.uncertainty_us
        if (
            self.leases.offer(event, LIMITS, now_us=now_us, uncertainty_us=uncertainty_us, now=self.now)
            is not None
        ):
            return
        assert not self.closed
        assert not self.held
        assert uncertainty_us is not None
        assert all(event.order > before.order for before in self.passed)
        assert now_us + uncertainty_us - event.sent_us <= min(event.valid_ms * 1000, 1_000_000)
        # A command is early only if it is early at every possible time.
        assert event.sent_us - now_us - uncertainty_us <= 500_000
        assert event.session not in self.refused
        if self.moving_until is not None and self.now < self.moving_until:
            assert event.takeover or event.session == self.passed[-1].session
        if self.passed and event.session == self.passed[-1].session:
            assert self.now - (now_us + uncertainty_us - event.sent_us) / 1e6 >= self.stopped
        self.passed.append(event)
        self.moving_until = self.now + left_s(event, now_us + uncertainty_us)


@given(EVENTS)
@example([(1,), command(seq=0, sent_us=T0 + 500_001, valid_ms=1, lease_ms=1)])
def test_the_promises_hold_for_any_events(events: list[Any]) -> None:
    model = Model()
    for event in events:
        if isinstance(event, float):
            model.wait(event)
        elif event in ("cut", "close", "hold"):
            model.end(event)
        elif event == "free":
            model.free()
        elif isinstance(event, tuple):
            (model.uncertainty_us,) = event
        elif isinstance(event, str):
            model.offset_us += -3_600_000_000 if event == "back" else 3_600_000_000
        else:
            model.offer(event)
    # From here on nobody sends.
    model.free()
    model.wait(3)
    assert model.moving_until is None
    assert model.leases.next_due() is None
