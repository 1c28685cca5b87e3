"""The hops of a live update are right with wrong clocks."""

from __future__ import annotations

import itertools

import pytest

from iort_contract.messages.batch import Batch
from iort_contract.messages.live import LiveSample, live_update
from iort_station.operations.trace import (
    BROKER,
    CAR,
    HERE,
    LAMBDA,
    PUBNUB,
    RULE,
    ClockOffset,
    clock_of,
    round_trips_ms,
    times,
    trace,
)

T_US = 1_750_000_000_000_000
# The true duration of each hop, in microseconds.
TRUE = {CAR: 700, RULE: 30_500, LAMBDA: 12_000, PUBNUB: 20_000, HERE: 15_000}


def _times(car_off_us, here_off_us, offset_us):
    """An update with these errors of the car's and the receiver's clocks."""
    sent = T_US + TRUE[CAR]
    rule = sent + TRUE[RULE]
    lambda_us, pubnub = rule + TRUE[LAMBDA], rule + TRUE[LAMBDA] + TRUE[PUBNUB]
    live = LiveSample("0badcafe", 1, T_US - car_off_us, sent - car_off_us, {"speed": 1}, 0, offset_us)
    update = live_update("car7", "vesc", live, rule // 1000, lambda_us)
    return times(update, pubnub, pubnub + TRUE[HERE] - here_off_us)


@pytest.mark.parametrize(
    ("car_off_us", "here_off_us"), [(0, 0), (3_600_000_000, -250_000), (-90_000, 10_000)]
)
def test_hops_are_right_with_wrong_clocks(car_off_us, here_off_us):
    found = trace(
        [_times(car_off_us, here_off_us, car_off_us)] * 3,
        here_to_pubnub=ClockOffset(here_off_us, 400),
        car_uncertainty_ms=1.5,
    )
    for hop in found.hops:
        assert hop.p50_ms == pytest.approx(TRUE[hop.name] / 1000, abs=0.6), hop
    assert found.whole.p50_ms == pytest.approx(sum(TRUE.values()) / 1000, abs=0.01)
    uncertain = {hop.name: hop.uncertainty_ms for hop in found.hops}
    assert uncertain == {CAR: 0.0, RULE: 1.5, LAMBDA: 0.5, PUBNUB: None, HERE: 0.4}
    assert found.whole.uncertainty_ms == pytest.approx(1.9)


def test_an_update_from_the_broker_has_two_hops():
    live = LiveSample("0badcafe", 1, T_US - 90_000, T_US - 89_300, {"speed": 1}, 0, 90_000)
    here_us = T_US + TRUE[CAR] + 25_000
    found = trace(
        [times(live_update("car7", "vesc", live), 0, here_us)], here_to_pubnub=None, car_uncertainty_ms=1.5
    )
    assert {hop.name: hop.p50_ms for hop in found.hops} == {CAR: 0.7, BROKER: 25.0}
    assert found.whole.p50_ms == pytest.approx(25.7)
    assert found.whole.uncertainty_ms is None


def test_a_car_without_a_clock_offset_has_no_uncertainty():
    found = trace([_times(0, 0, None)], here_to_pubnub=ClockOffset(0, 0), car_uncertainty_ms=1.5)
    assert {hop.name: hop.uncertainty_ms for hop in found.hops}[RULE] is None
    assert found.whole.uncertainty_ms is None


def test_the_fastest_answer_gives_the_clock_offset():
    ours = itertools.chain([0, 1000], [2000, 2100], [3000, 3800], itertools.count(10_000, 5000))
    clock = clock_of(lambda: 1_000_000, lambda: next(ours))
    assert clock == ClockOffset(1_000_000 - 2050, 50)


def test_round_trips_are_medians_of_the_newest_batch():
    columns = {
        "broker_ms": [1.0, None, 3.0, 2.0],
        "rule_ms": [None, 5.5, None, None],
        "lambda_ms": [None] * 4,
    }
    batch = Batch("0badcafe", 0, [1, 2, 3, 4], columns)
    assert round_trips_ms(batch) == {"broker": 2.0, "rule": 5.5}
    assert round_trips_ms(None) == {}
