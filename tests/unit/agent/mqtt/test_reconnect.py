"""The backoff, and which causes are logged."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.mqtt.failures import HANGUPS, Backoff, Cause, Causes


class Least(random.Random):
    def random(self) -> float:
        return 0.0


class Most(random.Random):
    def random(self) -> float:
        return 1.0


@given(st.lists(st.booleans(), max_size=40), st.integers())
def test_never_below_a_second_nor_above_the_cap(slow: list[bool], seed: int) -> None:
    backoff = Backoff(random.Random(seed))
    for one in slow:
        low, high = (60, 300) if one else (1, 30)
        assert low <= backoff.next_s(slow=one) <= high


def test_the_ceiling_doubles_and_the_first_wait_is_jittered_too() -> None:
    backoff = Backoff(Most())
    assert [backoff.next_s() for _ in range(6)] == [2, 4, 8, 16, 30, 30]
    assert [backoff.next_s(slow=True) for _ in range(4)] == [120, 240, 300, 300]
    backoff.reset()
    assert backoff.next_s(slow=True) == 120
    assert backoff.next_s() == 2, "another kind of cause begins anew"
    assert [Backoff(Least()).next_s() for _ in range(3)] == [1, 1, 1]


def test_a_cause_is_news_once() -> None:
    causes = Causes()
    a, b = Cause("a", "first"), Cause("b", "second")
    assert [causes.is_news(cause) for cause in (a, a, Cause("a", "other words"), b, a)] == [
        True, False, False, True, True,
    ]  # fmt: skip
    causes.connected()
    assert causes.is_news(a)


@pytest.mark.parametrize("before_tls", [False, True])
def test_only_disconnects_in_a_row_become_a_refusal(before_tls: bool) -> None:
    causes = Causes()
    told = [causes.hung_up(before_tls=before_tls) for _ in range(HANGUPS)]
    assert told == [(False, False)] * (HANGUPS - 1) + [(True, not before_tls)]
    causes.connected()
    assert causes.hung_up(before_tls=before_tls) == (False, False)


def test_a_reset_that_looks_like_a_tls_failure_is_not_a_refusal() -> None:
    causes = Causes()
    told = [causes.hung_up(before_tls=bool(i % 2)) for i in range(2 * HANGUPS)]
    assert told == [(i + 1 >= HANGUPS, False) for i in range(2 * HANGUPS)]
