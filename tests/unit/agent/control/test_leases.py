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
    NO_PICTURE,
    PICTURE_LATE,
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


SIGHTED = LIMITS._replace(picture_ms=500)


@pytest.mark.parametrize(
    ("changes", "picture_ms", "refusal"),
    [
        ({"frame": 7}, 500.0, None),
        ({"frame": 7}, 501.0, PICTURE_LATE),
        ({"frame": 7}, None, PICTURE_LATE),
        ({"frame": 7}, float("inf"), PICTURE_LATE),
        ({"frame": 7}, float("nan"), PICTURE_LATE),
        ({}, None, NO_PICTURE),
        ({"frame": 7, "blind": True}, 501.0, None),
        ({"blind": True}, None, None),
        ({"frame": 7, "ends": True}, 501.0, None),
        ({"ends": True}, None, None),
        # What else is against it goes first.
        ({"frame": 7, "sent_us": T0 - 800_001}, 501.0, STALE),
        ({"sent_us": T0 - 300_000}, None, LEASE_OVER),
        ({"lease_ms": None}, None, NO_LEASE),
    ],
)
def test_a_motion_by_a_picture(
    changes: dict[str, Any], picture_ms: float | None, refusal: str | None
) -> None:
    settings: dict[str, Any] = {"now_us": T0, "uncertainty_us": 0, "now": 7, "picture_ms": picture_ms}
    leases = Leases()
    assert leases.offer(command(**changes), SIGHTED, **settings) == refusal
    assert (leases.last is None) == (leases.next_due() is None) == (refusal is not None)
    if changes.keys() <= {"frame", "blind", "ends"}:
        assert Leases().offer(command(**changes), LIMITS, **settings) is None, "a robot without video"
        nothing = SIGHTED._replace(lease_s=None)
        assert Leases().offer(command(**changes), nothing, **settings) is None, "what moves nothing"


def test_a_late_picture_takes_no_wheel_and_costs_no_session() -> None:
    leases = Leases()

    def offer(letter: str, seq: int, picture_ms: float, **changes: Any) -> str | None:
        one = command(
            seq, session=letter * 8, started_us=T0 - 1_000_000 + int(letter, 16), frame=7, **changes
        )
        return leases.offer(one, SIGHTED, now_us=T0, uncertainty_us=0, now=7, picture_ms=picture_ms)

    assert offer("a", 0, 100) is None
    assert offer("b", 0, 501, takeover=True) == PICTURE_LATE
    assert offer("a", 1, 501) == PICTURE_LATE
    assert offer("a", 2, 100) is None, "its picture is live again"
    assert offer("b", 1, 501) == DRIVEN_BY_ANOTHER, "what else is against it goes first"
    assert offer("a", 2, 501) == REPEATED
    leases.hold(7)
    assert offer("c", 0, 501) == EMERGENCY_STOP
    leases.free()
    assert offer("c", 1, 100) == BEGIN_AGAIN


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

    def __init__(self, limits: Limits = LIMITS) -> None:
        self.leases, self.limits = Leases(), limits
        self.captured: list[float] = []  # when each picture was taken
        self.seq = 0
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
        # What ends a lease is a stop: the robot gets no other message of it.
        moves = self.moving_until is not None and not (self.passed[-1].blind or self.passed[-1].ends)
        if self.limits.picture_ms is not None and moves:
            frozen = self.now - max(self.captured, default=0.0)
            assert frozen <= self.limits.picture_ms / 1000 + 0.5 + TICK, "no longer than a lease"
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
        known = event.frame is not None and event.frame <= len(self.captured)
        picture_ms = (self.now - self.captured[event.frame - 1]) * 1000 if known else None
        times: dict[str, Any] = {"now_us": now_us, "uncertainty_us": uncertainty_us, "now": self.now}
        if self.leases.offer(event, self.limits, **times, picture_ms=picture_ms) is not None:
            return
        if self.limits.picture_ms is not None and not (event.blind or event.ends):
            assert picture_ms is not None
            assert picture_ms <= self.limits.picture_ms
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
        if self.passed and event.session == self.passed[-1].session and not event.ends:
            assert self.now - (now_us + uncertainty_us - event.sent_us) / 1e6 >= self.stopped
        self.passed.append(event)
        rest_s = left_s(event, now_us + uncertainty_us)
        self.moving_until = self.now if event.ends else self.now + rest_s


@given(EVENTS)
@example([(1,), command(seq=0, sent_us=T0 + 500_001, valid_ms=1, lease_ms=1)])
def test_the_promises_hold_for_any_events(events: list[Any]) -> None:
    happen(events, Model())


SEEING = st.lists(
    st.one_of(
        st.fixed_dictionaries(
            {
                "session": st.sampled_from(["0badcafe", "1badcafe"]),
                "takeover": st.booleans(),
                "ends": st.sampled_from([False, False, True]),
                "ago_us": st.sampled_from([0, 0, 100_000]),
                "lease_ms": st.integers(1, 2000),
                # How many pictures ago; -1 is one that is not taken yet.
                "behind": st.sampled_from([None, -1, 0, 0, 0, 1, 2]),
                "blind": st.sampled_from([False, False, False, True]),
            }
        ),
        st.floats(0, 0.6, allow_nan=False),
        st.sampled_from(["picture", "picture", "hold", "free"]),
    ),
    max_size=60,
)


_END = {"session": "0badcafe", "takeover": False, "ends": True, "ago_us": 0, "lease_ms": 31}


_BLIND = {**_END, "ends": False, "lease_ms": 430, "behind": None, "blind": True}


@given(SEEING)
@example([0.5, 0.5, 0.5, {**_END, "behind": None, "blind": False}])
# A motion that was sent before an emergency stop does not follow one that was sent after it.
@example(
    [
        0.125,
        _BLIND,
        "hold",
        "free",
        {**_BLIND, "session": "1badcafe"},
        {**_BLIND, "session": "1badcafe", "ago_us": 100_000},
    ]
)
# An end that was sent before the robot stopped moves nothing.
@example([_BLIND, 0.5, {**_END, "ago_us": 100_000, "lease_ms": 131, "behind": None, "blind": False}])
def test_a_picture_that_freezes_ends_motion_within_its_limit_and_a_lease(events: list[Any]) -> None:
    happen(events, Model(SIGHTED))


def happen(events: list[Any], model: Model) -> None:
    """Let the events happen, and what must be true then."""
    for event in events:
        if isinstance(event, float):
            model.wait(event)
        elif event in ("cut", "close", "hold"):
            model.end(event)
        elif event == "free":
            model.free()
        elif isinstance(event, dict):
            behind, now_us = event["behind"], T0 + round(model.now * 1e6) - event["ago_us"]
            frame = None if behind is None else max(1, len(model.captured) - behind)
            changes = {key: event[key] for key in ("session", "takeover", "ends", "lease_ms", "blind")}
            model.seq += 1
            model.offer(command(model.seq, **changes, sent_us=now_us, frame=frame))
        elif event == "picture":
            model.captured.append(model.now)
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
