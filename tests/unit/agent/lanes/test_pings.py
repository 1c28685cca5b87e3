"""Pings: round trips, losses, round trips as samples, and the clock's offset."""

from __future__ import annotations

import json
import random
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.common.schema import Place, load
from iort_agent.common.state import RoundTrips
from iort_agent.errors import ConfigError
from iort_agent.lanes import PingConfig
from iort_agent.lanes.pings import (
    CLOCK_EVERY_S,
    CLOCK_FIRST_EVERY_S,
    TIMEOUT_S,
    OffsetEstimator,
    Pings,
    percentile,
)
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS, MAX_MESSAGE_BYTES
from iort_contract.tables import RECEIVED_MS
from iort_contract.topics import PING_PATHS
from testkit.agent import Loopback, ManualClock, link_of

T0 = 1_700_000_000_000_000


class Rig:
    def __init__(
        self,
        *,
        rate_hz: float = 1,
        padding_bytes: int = 0,
        paths: tuple[str, ...] = PING_PATHS,
    ) -> None:
        self.clock = ManualClock(now_us=T0)
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.samples: list[tuple[str, int, Any]] = []
        self.stamps: list[tuple[float, float, int]] = []
        self.pings = Pings(
            link_of(self.uplink, self.clock),
            PingConfig(rate_hz, paths, padding_bytes),
            emit=lambda stream, t_us, values: self.samples.append((stream, t_us, values)),
            on_stamp=lambda *stamp: self.stamps.append(stamp),
        )
        self.uplink.connect()

    def answer(self, path: str, message: int = -1) -> None:
        """Deliver the cloud's answer to a sent ping."""
        ping = json.loads(self.uplink.published[message].payload)
        payload = json.dumps({**ping, RECEIVED_MS: 5}).encode()
        self.uplink.deliver(f"pong/iort/car1/{path}", payload)
        self.dispatcher.run_pending()


def test_a_ping_over_the_broker_comes_straight_back() -> None:
    rig = Rig()
    rig.pings.send("broker")
    rig.clock.advance(0.0125)
    rig.dispatcher.run_pending()
    # The time counts from the arrival, not from when the callback ran.
    assert rig.pings.report()["broker"] == RoundTrips(1, 1, 0, 0.0, 0.0)
    assert rig.uplink.published[0].topic == "ping/iort/car1/broker"
    assert rig.uplink.published[0].qos == 0


@pytest.mark.parametrize("path", ["rule", "lambda"])
def test_the_cloud_answers_on_the_pong_topic(path: str) -> None:
    rig = Rig()
    rig.pings.send(path)
    rig.clock.advance(0.0125)
    rig.answer(path)
    assert rig.pings.report()[path] == RoundTrips(1, 1, 0, 12.5, 12.5)
    ((stream, t_us, values),) = rig.samples
    assert (stream, t_us) == ("rtt", T0 + 12_500)
    others = {f"{name}_ms": None for name in PING_PATHS if name != path}
    assert values == {**others, f"{path}_ms": 12.5}


def test_lost_pings_are_counted_and_late_answers_ignored() -> None:
    rig = Rig()
    for _ in range(3):
        rig.pings.send("rule")
    rig.answer("rule", 0)
    rig.clock.advance(TIMEOUT_S + 1)
    rig.pings.tick()
    rig.answer("rule", 1)
    report = rig.pings.report()["rule"]
    assert (report.sent, report.received, report.lost) == (3, 1, 2)
    assert len(rig.samples) == 1


def test_other_answers_are_ignored() -> None:
    rig = Rig()
    rig.pings.send("rule")
    for payload in (b"", b"[]", b'{"id": "x"}', b'{"id": 999, "sent_us": 1}', b"\xff"):
        rig.uplink.deliver("pong/iort/car1/rule", payload)
    rig.answer("lambda")  # the right number by the wrong path
    rig.answer("rule")
    rig.answer("rule")  # twice
    assert rig.pings.report()["rule"] == RoundTrips(1, 1, 0, 0.0, 0.0)
    assert rig.pings.report()["lambda"] == RoundTrips(0, 0, 0, None, None)


def test_no_ping_without_a_subscription_for_its_answer() -> None:
    rig = Rig()
    rig.uplink.cut()
    rig.pings.send("broker")
    assert rig.pings.report()["broker"].sent == 0


def test_paths_take_turns_at_the_rate() -> None:
    rig = Rig(rate_hz=10, padding_bytes=450)
    stop = threading.Event()
    start, times = rig.clock.monotonic(), []

    def verdict(message: Any) -> None:
        times.append((message.topic.rsplit("/", 1)[1], round(rig.clock.monotonic() - start, 6)))
        if len(times) == 30:
            stop.set()

    rig.uplink.verdict = verdict
    rig.pings.run(stop)
    assert [path for path, _ in times[:3]] == ["broker", "rule", "lambda"]
    assert [at for path, at in times if path == "rule"] == [round(1 / 30 + i / 10, 6) for i in range(10)]
    assert 480 < len(rig.uplink.published[0].payload) < 560


def test_the_largest_ping_and_its_answer_fit_into_a_message(
    tmp_path: Path,
) -> None:
    where = Place(tmp_path / "car.yaml")
    largest = 100_000
    assert load(PingConfig, {"padding_bytes": largest}, where).padding_bytes == largest
    with pytest.raises(ConfigError, match=f"0 to {largest}"):
        load(PingConfig, {"padding_bytes": largest + 1}, where)
    rig = Rig(padding_bytes=largest)
    rig.pings.send("rule")
    (ping,) = rig.uplink.published
    assert len(ping.payload) > largest
    pong = {**json.loads(ping.payload), RECEIVED_MS: rig.clock.now_us() // 1000}
    assert len(json.dumps(pong)) <= MAX_MESSAGE_BYTES


def test_the_end_waits_for_answers_for_a_limited_time() -> None:
    rig = Rig()
    rig.pings.send("broker")
    rig.pings.send("rule")
    rig.dispatcher.run_pending()
    rig.pings.close(0)
    assert rig.pings.report()["broker"].lost == 0
    assert rig.pings.report()["rule"].lost == 1


@given(st.lists(st.floats(0, 1e6), min_size=1), st.integers(1, 100))
def test_percentile_is_a_value_with_that_share_below(values: list[float], percent: int) -> None:
    found = percentile(values, percent)
    assert found in values
    assert sum(v <= found for v in values) >= len(values) * percent / 100
    assert sum(v < found for v in values) < len(values) * percent / 100


@pytest.mark.parametrize(("rate_hz", "paths"), [(0, PING_PATHS), (0, ("broker",)), (5, ("broker", "lambda"))])
def test_rare_pings_measure_the_clock_offset_if_no_rule_trip_is_measured(
    rate_hz: float, paths: tuple[str, ...]
) -> None:
    rig = Rig(rate_hz=rate_hz, paths=paths)
    start, times = rig.clock.monotonic(), []
    rig.uplink.cut()
    for step in range(800):
        if step == 40:
            rig.uplink.connect()
        sent = len(rig.uplink.published)
        rig.pings.tick()
        if len(rig.uplink.published) > sent:
            assert rig.uplink.published[-1].topic == "ping/iort/car1/rule"
            times.append(round(rig.clock.monotonic() - start, 3))
            if len(times) == 3:
                rig.answer("rule")
        rig.clock.advance(0.125)
    # Often until the first answer, then rarely.
    first = [5 + i * CLOCK_FIRST_EVERY_S for i in range(4)]
    assert times == [*first, *(first[-1] + i * CLOCK_EVERY_S for i in (1, 2, 3))]
    assert rig.stamps == [(start + times[2], start + times[2], 5)]
    assert rig.samples == [], "it is no measurement of round trips"


def test_measured_rule_trips_give_the_clock_offset_without_more_pings() -> None:
    rig = Rig()
    rig.pings.send("rule")
    rig.clock.advance(0.5)
    rig.answer("rule")
    assert [stamp_ms for _, _, stamp_ms in rig.stamps] == [5]
    rig.pings.tick()
    assert len(rig.uplink.published) == 1


def test_the_rate_can_be_changed_while_it_runs() -> None:
    rig = Rig(rate_hz=1)
    stop, times = threading.Event(), []

    def verdict(_: Any) -> None:
        times.append(rig.clock.monotonic())
        if len(times) == 6:
            rig.pings.set_rate(10)
        if len(times) == 12:
            stop.set()

    rig.uplink.verdict = verdict
    rig.pings.run(stop)
    gaps = [times[i + 1] - times[i] for i in range(len(times) - 1)]
    assert gaps[1] == pytest.approx(1 / 3)
    assert gaps[-1] == pytest.approx(1 / 30)


def test_percentile_of_nothing() -> None:
    assert percentile([], 50) is None


@given(
    st.floats(-1e7, 1e7), st.lists(st.tuples(st.floats(0.2, 500), st.floats(0, 1)), min_size=1), st.randoms()
)
def test_the_offset_is_within_its_uncertainty(
    true_ms: float, trips: list[tuple[float, float]], chance: random.Random
) -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    for trip_ms, share in trips:
        sent = clock.monotonic()
        # The cloud stamps in whole milliseconds, at any time on the way.
        stamp_ms = int(clock.now_us() / 1000 + trip_ms * share + true_ms)
        clock.advance(trip_ms / 1000)
        offset.add(sent, clock.monotonic(), stamp_ms)
        clock.advance(chance.random())
    found = offset.estimate()
    assert found is not None
    assert abs(found.offset_ms - true_ms) <= found.uncertainty_ms + 0.51
    assert found.uncertainty_ms >= min(trip_ms for trip_ms, _ in trips) / 2


def test_the_offset_is_right_at_once_after_the_clock_is_set() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    assert offset.estimate() is None
    sent = clock.monotonic()
    clock.advance(0.01)
    offset.add(sent, clock.monotonic(), clock.now_us() // 1000 - 5)
    before = offset.estimate()
    clock.set_wall(clock.now_us() - 3_600_000_000)
    after = offset.estimate()
    assert before is not None
    assert after is not None
    assert after.offset_ms - before.offset_ms == pytest.approx(3_600_000)


def test_the_shortest_round_trip_is_used_until_it_is_old() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    for trip_ms in (10, 2, 200):
        sent = clock.monotonic()
        clock.advance(trip_ms / 1000)
        offset.add(sent, clock.monotonic(), clock.now_us() // 1000)
    found = offset.estimate()
    assert found is not None
    assert found.uncertainty_ms == pytest.approx(1.5, abs=0.02)
    clock.advance(60)
    aged = offset.estimate()
    assert aged is not None
    assert aged.uncertainty_ms == pytest.approx(4.5, abs=0.02), "the clocks may have drifted by 3 ms"


def test_an_uncertain_offset_is_not_used() -> None:
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    assert offset.known_us() is None
    for trip_s, known in ((1.5, False), (0.9, True), (8, True)):
        sent = clock.monotonic()
        stamp_ms = clock.now_us() // 1000 + 60_000
        clock.advance(trip_s)
        offset.add(sent, clock.monotonic(), stamp_ms)
        assert (offset.known_us() is not None) == known
    known_us = offset.known_us()
    assert known_us is not None
    assert abs(known_us - 60_000_000) <= CLOCK_MAX_UNCERTAINTY_MS * 1000
    clock.advance(86_400)
    assert offset.known_us() is None, "two oscillators drift apart"


def test_a_contradicting_round_trip_replaces_the_best_one() -> None:
    """While a computer sleeps, its monotonic clock stops and its wall clock goes on."""
    clock = ManualClock()
    offset = OffsetEstimator(clock)
    slept_us = 0
    for trip_s in (0.002, 0.3):
        sent = clock.monotonic()
        clock.advance(trip_s)
        offset.add(sent, clock.monotonic(), (clock.now_us() + slept_us) // 1000)
        slept_us += 600_000_000
    found = offset.estimate()
    assert found is not None
    assert found.offset_ms == pytest.approx(600_000, abs=found.uncertainty_ms)
