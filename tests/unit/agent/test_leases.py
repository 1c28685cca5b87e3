"""Which commands pass and when the robot stops, for any order of events."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iort_agent.control.leases import (
    CLOSED,
    EARLY,
    LEASE_OVER,
    NO_LEASE,
    REPEATED,
    STALE,
    STOP_REPEAT_S,
    STOP_REPEATS,
    SUPERSEDED,
    Leases,
    Limits,
)
from iort_contract.messages.commands import Command

T0 = 1_700_000_000_000_000
LIMITS = Limits(max_age_s=1.0, max_ahead_s=0.5, lease_s=0.5)


def command(seq: int = 0, **changes: Any) -> Command:
    settings: dict[str, Any] = {
        "session": "0badcafe",
        "started_us": T0 - 1_000_000,
        "sent_us": T0,
        "valid_ms": 800,
    }
    return Command(**{**settings, "seq": seq, "message": {}, "lease_ms": 300, **changes})


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
    assert Leases(LIMITS).offer(command(**changes), now_us=T0, uncertainty_us=0, now=0) == refusal


def test_only_a_later_command_passes() -> None:
    leases = Leases(LIMITS)
    later, earlier = {"started_us": T0, "session": "1badcafe"}, {"started_us": T0 - 1_000_000}
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
        assert leases.offer(command(seq, **session), now_us=T0, uncertainty_us=0, now=0) == refusal


def test_a_command_without_motion_needs_no_lease_and_no_stop() -> None:
    leases = Leases(Limits(1.0, 0.5))
    assert leases.offer(command(lease_ms=None), now_us=T0, uncertainty_us=0, now=0) is None
    assert leases.next_due() is None
    assert not leases.stop_due(1e9)


def stops(leases: Leases, until: float, step: float = 0.01) -> list[float]:
    return [round(i * step, 3) for i in range(round(until / step) + 1) if leases.stop_due(i * step)]


def test_the_end_of_a_lease_repeats_the_stop_a_few_times() -> None:
    leases = Leases(LIMITS)
    leases.offer(command(), now_us=T0, uncertainty_us=0, now=0)
    assert stops(leases, 10) == [round(0.3 + i * STOP_REPEAT_S, 3) for i in range(STOP_REPEATS + 1)]
    assert leases.next_due() is None


def test_the_robots_own_limit_is_the_shorter_one() -> None:
    leases = Leases(LIMITS)
    leases.offer(command(lease_ms=10_000), now_us=T0, uncertainty_us=0, now=0)
    assert leases.next_due() == 0.5


@pytest.mark.parametrize(("age_us", "uncertainty_us"), [(200_000, 0), (50_000, 150_000), (0, 200_000)])
def test_the_lease_runs_from_when_the_command_may_have_been_sent(age_us: int, uncertainty_us: int) -> None:
    leases = Leases(LIMITS)
    assert leases.offer(command(sent_us=T0 - age_us), now_us=T0, uncertainty_us=uncertainty_us, now=7) is None
    assert leases.next_due() == pytest.approx(7.1)


def test_a_sender_whose_clock_is_ahead_gets_no_longer_lease() -> None:
    leases = Leases(LIMITS)
    assert leases.offer(command(sent_us=T0 + 500_000), now_us=T0, uncertainty_us=0, now=7) is None
    assert leases.next_due() == pytest.approx(7.3)


def test_a_renewed_lease_has_no_stop() -> None:
    leases = Leases(LIMITS)
    for i in range(10):
        assert leases.offer(command(i), now_us=T0, uncertainty_us=0, now=i * 0.29) is None
        assert not leases.stop_due(i * 0.29 + 0.28)


def test_a_newer_command_ends_the_stops() -> None:
    leases = Leases(LIMITS)
    leases.offer(command(), now_us=T0, uncertainty_us=0, now=0)
    assert leases.stop_due(0.3)
    assert leases.offer(command(1), now_us=T0, uncertainty_us=0, now=0.4) is None
    assert not leases.stop_due(0.6)


def test_cut_and_closed() -> None:
    leases = Leases(LIMITS)
    leases.cut(0)
    assert leases.next_due() is None, "nothing moved"
    leases.offer(command(), now_us=T0, uncertainty_us=0, now=0)
    leases.cut(0.1)
    assert leases.stop_due(0.1)
    leases.offer(command(1), now_us=T0, uncertainty_us=0, now=0.2)
    leases.close(0.25)
    assert leases.stop_due(0.25)
    assert leases.offer(command(2), now_us=T0, uncertainty_us=0, now=0.3) == CLOSED


# Any sequence of events of an operator, a network and a clock.

COMMANDS = st.builds(
    command,
    seq=st.integers(0, 6),
    session=st.sampled_from(["0badcafe", "1badcafe"]),
    started_us=st.sampled_from([T0 - 1_000_000, T0 - 2_000_000]),
    sent_us=st.integers(T0 - 3_000_000, T0 + 3_000_000),
    valid_ms=st.integers(1, 3000),
    lease_ms=st.one_of(st.none(), st.integers(1, 2000)),
)
EVENTS = st.lists(
    st.one_of(
        COMMANDS,
        st.floats(0, 1, allow_nan=False),  # time passes
        st.sampled_from(["cut", "close", "back", "forth"]),  # the wall clock may jump
        # The uncertainty of the clock offset from now on.
        st.tuples(st.one_of(st.none(), st.integers(0, 500_000))),
    ),
    max_size=60,
)
TICK = 0.05


def left_s(motion: Command, latest_us: int) -> float:
    """The rest of a lease, at the latest time that it may be."""
    assert motion.lease_ms is not None
    left = min(motion.lease_ms / 1000, 0.5) - max(0, latest_us - motion.sent_us) / 1e6
    assert left > 0, "what has no time left does not move"
    return left


@given(EVENTS)
@example([(1,), command(seq=0, sent_us=T0 + 500_001, valid_ms=1, lease_ms=1)])
def test_the_promises_hold_for_any_events(events: list[Any]) -> None:
    leases = Leases(LIMITS)
    now, offset_us, closed = 0.0, 0, False
    uncertainty_us: int | None = 0
    passed: list[Command] = []
    moving_until: float | None = None  # of the model: the last motion's end

    def tick() -> None:
        nonlocal moving_until
        due = leases.next_due()
        said = leases.stop_due(now)
        assert said == (due is not None and due <= now)
        if moving_until is not None and now >= moving_until:
            assert said, "a stop follows the last motion by the first tick after its lease"
            moving_until = None
        elif said:
            assert moving_until is None, "nothing stops a motion whose lease holds"

    for event in events:
        if isinstance(event, float):
            end = now + event
            while now < end:
                now = min(end, now + TICK)
                tick()
        elif event == "cut":
            leases.cut(now)
            moving_until = None if moving_until is None else min(moving_until, now)
            tick()
        elif event == "close":
            leases.close(now)
            closed = True
            moving_until = None if moving_until is None else min(moving_until, now)
            tick()
        elif isinstance(event, tuple):
            (uncertainty_us,) = event
        elif isinstance(event, str):
            offset_us += -3_600_000_000 if event == "back" else 3_600_000_000
        else:
            now_us = T0 + round(now * 1e6) + offset_us
            if leases.offer(event, now_us=now_us, uncertainty_us=uncertainty_us, now=now) is None:
                assert not closed
                assert uncertainty_us is not None
                assert all(event.order > before.order for before in passed)
                assert now_us + uncertainty_us - event.sent_us <= min(event.valid_ms * 1000, 1_000_000)
                # A command is early only if it is early at every possible time.
                assert event.sent_us - now_us - uncertainty_us <= 500_000
                passed.append(event)
                moving_until = now + left_s(event, now_us + uncertainty_us)
    # From here on nobody sends.
    end = now + 3
    while now < end:
        now += TICK
        tick()
    assert moving_until is None
    assert leases.next_due() is None
