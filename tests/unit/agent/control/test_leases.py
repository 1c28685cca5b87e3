"""Which commands pass and when the robot stops, for any order of events."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iort_agent.control.leases import STOP_AHEAD_MS, STOP_HOLD_S, STOP_REPEAT_S, STOP_REPEATS, Leases, Limits
from iort_contract.messages.commands import (
    BEGIN_AGAIN,
    CLOCK_UNKNOWN,
    CLOSED,
    DRIVEN_BY_ANOTHER,
    EARLY,
    EMERGENCY_STOP,
    LEASE_OVER,
    NO_LEASE,
    REPEATED,
    STALE,
    SUPERSEDED,
    Command,
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
    ("changes", "uncertainty_us", "refusal", "left_s"),
    [
        ({}, 0, None, 0.3),
        ({"sent_us": T0 - 299_999}, 0, None, 0.0),
        ({"sent_us": T0 - 300_000}, 0, LEASE_OVER, None),
        # The robot's own limit is the shorter one.
        ({"lease_ms": 10_000}, 0, None, 0.5),
        ({"sent_us": T0 - 499_999, "lease_ms": 10_000}, 0, None, 0.0),
        ({"sent_us": T0 - 500_000, "lease_ms": 10_000}, 0, LEASE_OVER, None),
        ({"sent_us": T0 - 800_001}, 0, STALE, None),
        ({"sent_us": T0 - 1_000_001, "valid_ms": 60_000}, 0, STALE, None),
        # A sender whose clock is ahead gets no longer lease.
        ({"sent_us": T0 + 500_000}, 0, None, 0.3),
        ({"sent_us": T0 + 500_001}, 0, EARLY, None),
        ({"lease_ms": None}, 0, NO_LEASE, None),
        # The lease runs from when the command may have been sent.
        ({"sent_us": T0 - 200_000}, 0, None, 0.1),
        ({"sent_us": T0 - 50_000}, 150_000, None, 0.1),
        ({}, 200_000, None, 0.1),
        ({}, None, CLOCK_UNKNOWN, None),
    ],
)
def test_a_single_command(
    changes: dict[str, Any], uncertainty_us: int | None, refusal: str | None, left_s: float | None
) -> None:
    leases = Leases()
    offer = leases.offer(command(**changes), LIMITS, now_us=T0, uncertainty_us=uncertainty_us, now=7)
    assert offer == refusal
    assert leases.next_due() == (None if left_s is None else pytest.approx(7 + left_s, abs=1e-5))


def test_a_command_without_motion_needs_no_lease_and_no_stop() -> None:
    leases = Leases()
    assert leases.offer(command(lease_ms=None), Limits(1.0, 0.5), now_us=T0, uncertainty_us=0, now=0) is None
    assert leases.next_due() is None
    assert not leases.stop_due(1e9)


class Offer(NamedTuple):
    """A command of a session, offered when it is sent, or later."""

    session: str
    seq: int
    changes: dict[str, Any]


def offer_of(letter: str) -> Callable[..., Offer]:
    return lambda seq, **changes: Offer(letter * 8, seq, changes)


A, B, C = map(offer_of, "abc")
STOP, STOPS, DRIVER, DUE = "stop", "stops", "driver", "due"
# Name -> steps: the second, what happens (a command or how all ends) or is asked, and the answer. STOPS asks
# for the number of stops since the step before.
SCENARIOS: dict[str, list[tuple[float, Any, Any]]] = {
    "only a later command passes": [
        (0, A(5), None), (0, A(5), REPEATED), (0, A(4), REPEATED), (0, A(7), None),
        (0, B(0, takeover=True), None), (0, A(8), SUPERSEDED), (0, B(1), None),
    ],
    "one session drives until another takes over": [
        (0, A(0), None), (0, B(0), DRIVEN_BY_ANOTHER), (0, C(0, takeover=True), None), (0, A(1), SUPERSEDED),
        (0.2, DRIVER, ("cccccccc", pytest.approx(0.1))), (0.3, DRIVER, (None, 0)),
    ],
    "a stick held while another drove moves nothing when that one lets go; the next press does": [
        (0, A(0), None), (0, B(0), DRIVEN_BY_ANOTHER), (0.4, B(1), BEGIN_AGAIN),
        (0.4, B(2, takeover=True), BEGIN_AGAIN), (0.4, C(0), None),
    ],
    "a motion that ends its lease lets others drive": [
        (0, A(0), None), (0.1, A(1, ends=True), None), (0.1, DRIVER, (None, 0)), (0.1, B(0), None),
        (0.1, A(2, ends=True), SUPERSEDED), (0.1, STOP, False),
    ],
    "a motion that ends its lease stops the robot": [
        (0, A(0), None), (0.1, A(1, ends=True), None), (0.1, STOP, True),
    ],
    "an emergency stop holds until it is released, and ends every session": [
        (0, A(0), None), (0.1, "hold", None), (0.1, DRIVER, (None, 0)),
        (0.95, STOPS, pytest.approx(0.85 / STOP_HOLD_S, abs=1)), (1, A(1), EMERGENCY_STOP),
        (1, B(0, takeover=True), EMERGENCY_STOP), (1, "free", None), (1.1, A(2), BEGIN_AGAIN),
        (1.1, B(1, takeover=True), BEGIN_AGAIN), (1.2, C(0), None),
    ],
    "a stick that is held is refused however many others try": [
        (0, "hold", None),
        *[(0.1, one, EMERGENCY_STOP) for i in range(200) for one in (A(i), Offer(f"{i:08x}", 0, {}))],
        (0.1, "free", None), (0.2, A(200), BEGIN_AGAIN),
    ],
    "a released emergency stop ends after a few stops": [
        (0, "hold", None), (0, STOP, True), (0, "free", None), (10, STOPS, STOP_REPEATS), (10, DUE, None),
    ],
    "so does that of an agent that ends": [
        (0, "hold", None), (0, STOP, True), (0, "close", None), (10, STOPS, STOP_REPEATS), (10, DUE, None),
    ],
    "the end of a lease repeats the stop a few times": [
        (0, A(0), None), (0.29, STOPS, 0), (0.3, STOPS, 1), (0.3 + STOP_REPEAT_S - 0.01, STOPS, 0),
        (10, STOPS, STOP_REPEATS), (10, DUE, None),
    ],
    "a renewed lease has no stop": [
        step for i in range(10) for step in ((i * 0.29, A(i), None), (i * 0.29 + 0.28, STOP, False))
    ],
    "a newer command ends the stops": [
        (0, A(0), None), (0.3, STOP, True), (0.4, A(1), None), (0.6, STOP, False),
    ],
    "what a session sent before the stop moves nothing after it": [
        (0, A(0), None), (0.3, STOP, True), (0.35, A(1, sent_us=T0 + 150_000), LEASE_OVER),
        (0.35, A(2, sent_us=T0 + 300_000), None),
    ],
    "a command that waited in a frozen agent beside the stop moves nothing": [
        (0, A(0), None), (0.35, A(1, sent_us=T0 + 150_000), LEASE_OVER), (0.35, STOP, True),
    ],
    "cut and closed": [
        (0, "cut", None), (0, DUE, None), (0, A(0), None), (0.1, "cut", None), (0.1, STOP, True),
        (0.2, A(1), None), (0.25, "close", None), (0.25, STOP, True), (0.3, A(2), CLOSED),
    ],
}  # fmt: skip


@pytest.mark.parametrize("steps", SCENARIOS.values(), ids=list(SCENARIOS))
def test_a_scenario(steps: list[tuple[float, Any, Any]]) -> None:
    leases, before = Leases(), 0.0
    for number, (now, what, expected) in enumerate(steps):
        answer: Any = None
        if isinstance(what, Offer):
            now_us = T0 + round(now * 1e6)
            started_us = T0 - 1_000_000 + int(what.session[0], 16)
            settings = {"session": what.session, "started_us": started_us, "sent_us": now_us, **what.changes}
            answer = leases.offer(
                command(what.seq, **settings), LIMITS, now_us=now_us, uncertainty_us=0, now=now
            )
        elif what == STOP:
            answer = leases.stop_due(now)
        elif what == STOPS:
            answer = sum(leases.stop_due(i / 100) for i in range(round(before * 100), round(now * 100) + 1))
        elif what == DRIVER:
            driver = leases.driver(now)
            answer = driver.session if driver is not None else None, leases.left_s(now)
        elif what == DUE:
            answer = leases.next_due()
        elif what == "free":
            leases.free()
        else:
            getattr(leases, what)(now)
        assert answer == expected, f"step {number}: {what}"
        before = now


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
