"""What came again, and what did not come."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.sources.rosbridge import Numbers, Repeats


@pytest.mark.parametrize(
    ("numbers", "missed"),
    [
        ([7, 8, 9], 0),
        ([7, 9, 12], 3),
        ([0, 0, 0], 0),
        ([100, 101, 1, 2, 3], 0),
        ([100, 101, 1, 2, 5], 2),
        ([100, 1, 101, 2, 102], 0),
        ([100, 5000, 101, 5001], 0),
        ([100, 5000, 101, 5001, 111, 5011], 18),
        ([3, 4_000_000, 4_000_001], 0),
    ],
    ids=[
        "in order", "gaps", "not counted up", "started again", "a gap after that", "two publishers",
        "the second is far ahead", "both missed some", "too far to be a gap",
    ],
)  # fmt: skip
def test_what_is_missing(numbers: list[int], missed: int) -> None:
    counted = Numbers()
    for number in numbers:
        counted.take(number)
    assert counted.missed == missed


@given(
    st.lists(st.booleans(), min_size=1, max_size=200),
    st.integers(0, 50),
    st.integers(1_000, 2_000),
    st.integers(1, 40),
)
def test_two_publishers_that_lose_the_same_stretch(order: list[bool], a: int, b: int, lost: int) -> None:
    """However their messages are mixed, what is missing is known once both have spoken before and after."""
    following, counted = {True: a, False: b}, Numbers()
    for publisher in [True, False, *order]:
        counted.take(following[publisher])
        following[publisher] += 1
    assert counted.missed == 0 or not {True, False} <= set(order)
    counted.take(following[True])
    counted.take(following[False])
    for publisher in (True, False):
        following[publisher] += 1 + lost
    for publisher in [True, False, *order]:
        counted.take(following[publisher])
        following[publisher] += 1
    assert counted.missed == 2 * lost


MAP = b'{"op": "publish", "topic": "/map", "msg": {"data": "a map"}}'


def test_a_latched_message_comes_with_every_subscription() -> None:
    repeats = Repeats()
    repeats.subscribed(0.0)
    assert not repeats.came_before(MAP, 0.1, stamped=False)
    for n in range(1, 5):
        repeats.subscribed(100.0 * n)
        assert repeats.came_before(MAP, 100.0 * n + 1, stamped=False)
    assert not repeats.came_before(b"another map", 500.0, stamped=False)


def test_each_of_several_latching_publishers_comes_again() -> None:
    repeats = Repeats()
    parts = [b"left", b"right", b"top"]
    assert not any(repeats.came_before(part, 0.0, stamped=True) for part in parts)
    repeats.subscribed(10.0)
    assert not repeats.came_before(b"new", 10.1, stamped=True)
    assert all(repeats.came_before(part, 10.2, stamped=True) for part in reversed(parts))
    assert not repeats.came_before(b"left", 10.3, stamped=True), "once for each subscription"


def test_a_topic_that_repeats_itself_is_taken_as_it_comes() -> None:
    repeats = Repeats()
    assert [repeats.came_before(b"on", float(n), stamped=False) for n in range(3)] == [False] * 3
    repeats.subscribed(3.0)
    assert not repeats.came_before(b"on", 3.1, stamped=False)


def test_long_after_the_subscription_it_is_a_message_like_any() -> None:
    repeats = Repeats()
    repeats.came_before(MAP, 0.0, stamped=False)
    repeats.subscribed(1.0)
    assert not repeats.came_before(MAP, 60.0, stamped=False)
