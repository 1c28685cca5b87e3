"""A try of a failure while a car is driven: whether its stop came in time, and why not."""

from __future__ import annotations

import pytest

from bench.load.tries import Heard, Try


def tried(*heard: tuple[float, float]) -> Try:
    """The failure is at 10 s; each message is a time and a speed."""
    return Try("x", 1, Heard(10.0, 0.0, 0.0), [Heard(at, 0.0, speed) for at, speed in heard], lease_s=0.5)


@pytest.mark.parametrize(
    ("heard", "why"),
    [
        ([(9.9, 1.0), (10.1, 1.0), (10.55, 0.0)], ""),
        ([(9.9, 1.0), (10.6, 0.0)], "the stop came 600 ms after the last motion or the failure"),
        ([(9.9, 1.0), (10.1, 0.0), (10.2, 1.0), (10.3, 0.0)], "a motion came 100 ms after the first stop"),
        ([(9.9, 1.0), (10.1, 0.0), (10.2, 1.0)], "no stop"),
        ([(9.9, 1.0)], "no stop"),
    ],
)
def test_a_try_tells_why_it_failed(heard: list[tuple[float, float]], why: str) -> None:
    one = tried(*heard)
    assert one.driven
    assert one.why == why


def test_a_car_that_stood_already_is_no_try() -> None:
    assert not tried((9.8, 1.0), (9.9, 0.0), (10.1, 0.0)).driven
    assert tried((9.9, 0.0), (10.1, 1.0), (10.2, 0.0)).driven, "it moved after the failure"
