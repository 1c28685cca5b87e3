"""The record lane: in order, at least once, out of the spool with the PUBACK only."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.lanes.record import RecordLane
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.rate_limiter import RateLimiter
from testkit.agent import Loopback, ManualClock, MemorySpool
from tests.examples import examples


class Rig:
    def __init__(self, *, window: int = 20, publishes_per_s: float = 1e6, bytes_per_s: float = 1e9) -> None:
        self.clock = ManualClock()
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.spool = MemorySpool(max_bytes=2**40)
        self.put_all = 0
        self.lane = RecordLane(
            robot="car1",
            namespace="iort",
            spool=self.spool,
            uplink=self.uplink,
            clock=self.clock,
            rate_limiter=RateLimiter(
                self.clock, publishes_per_s=publishes_per_s, bytes_per_s=bytes_per_s
            ),
            window=window,
            chance=random.Random(1),
        )  # fmt: skip

    def put(self, count: int, size: int = 10) -> None:
        for _ in range(count):
            self.spool.put("vesc", "0badcafe", self.put_all, b"%0*d" % (size, self.put_all), samples=1)
            self.put_all += 1

    def turn(self) -> float | None:
        """Let the lane and the callbacks run until neither has more to do at this moment."""
        while True:
            self.dispatcher.run_pending()
            self.lane._wake.clear()
            delay = self.lane.step()
            self.dispatcher.run_pending()
            if not self.lane._wake.is_set():
                return delay

    def finish(self) -> None:
        """Let time pass as the lane asks for, until the spool is empty."""
        while self.left():
            delay = self.turn()
            assert delay is not None or not self.left(), "the lane waits for nothing"
            self.clock.advance(delay or 0.0)

    def sent(self) -> list[int]:
        return [int(message.payload) for message in self.uplink.published]

    def left(self) -> int:
        return self.spool.backlog().batches


def test_publishes_in_order_at_qos_1_on_the_basic_ingest_topic() -> None:
    rig = Rig()
    rig.uplink.connect()
    rig.put(50)
    rig.turn()
    assert rig.sent() == list(range(50))
    assert {(m.topic, m.qos) for m in rig.uplink.published} == {
        ("$aws/rules/iort_record/dt/iort/car1/vesc", 1)
    }
    assert rig.left() == 0


def test_a_window_of_messages_waits_for_acknowledgements() -> None:
    rig = Rig(window=4)
    rig.uplink.connect()
    rig.uplink.hold = True
    rig.put(10)
    rig.turn()
    assert rig.sent() == [0, 1, 2, 3]
    assert rig.left() == 10, "unacknowledged batches stay"
    rig.uplink.release(count=2)
    rig.turn()
    assert rig.sent() == [0, 1, 2, 3, 4, 5]
    assert rig.left() == 8


def test_a_lost_connection_sends_again_what_was_not_acknowledged() -> None:
    rig = Rig(window=4)
    rig.uplink.connect()
    rig.uplink.hold = True
    rig.put(6)
    rig.turn()
    rig.uplink.release(count=1)
    rig.uplink.cut()
    rig.turn()
    assert rig.sent() == [0, 1, 2, 3]
    assert rig.left() == 5
    rig.uplink.hold = False
    rig.uplink.connect()
    rig.turn()
    assert rig.sent() == [0, 1, 2, 3, 1, 2, 3, 4, 5]
    assert rig.left() == 0


def test_a_failed_publish_is_sent_again_after_a_pause_and_before_newer_ones() -> None:
    rig = Rig(window=3)
    rig.uplink.connect()
    rig.uplink.hold = True
    rig.put(6)
    rig.turn()
    rig.uplink.release(error="quota exceeded", count=1)
    delay = rig.turn()
    rig.clock.advance(40)
    assert delay is None
    assert rig.turn() is None
    assert rig.sent() == [0, 1, 2], "nothing new while others are on their way"
    rig.uplink.hold = False
    rig.uplink.release()
    rig.turn()
    assert rig.sent() == [0, 1, 2, 0, 3, 4, 5]
    assert rig.left() == 0


def test_pauses_grow_while_the_broker_refuses_and_a_good_one_resets_them() -> None:
    rig = Rig(window=1)
    rig.uplink.connect()
    rig.uplink.verdict = lambda _: "not authorized"
    rig.put(1)
    pauses = []
    # Hours: a cloud whose disk is full over the weekend.
    for _ in range(1100):
        pause = rig.turn()
        assert pause is not None
        pauses.append(pause)
        rig.clock.advance(pause)
    assert max(pauses) > 10
    assert max(pauses) <= 30
    assert min(pauses) >= 0.4
    rig.uplink.verdict = lambda _: None
    rig.clock.advance(30)
    rig.turn()
    assert rig.left() == 0
    rig.uplink.verdict = lambda _: "again"
    rig.put(1)
    again = rig.turn()
    assert again is not None
    assert again < 1


def test_an_acknowledgement_that_comes_late_still_counts() -> None:
    rig = Rig()
    rig.uplink.connect()
    rig.uplink.hold = True
    rig.put(1)
    rig.turn()
    late = list(rig.uplink._waiting)
    rig.uplink.cut()
    rig.uplink.connect()
    rig.turn()
    assert rig.sent() == [0, 0]
    late[0](None)
    assert rig.left() == 0


def test_keeps_below_the_limits_of_a_connection() -> None:
    rig = Rig(publishes_per_s=100, bytes_per_s=512 * 1024)
    rig.uplink.connect()
    rig.put(2000)
    start = rig.clock.monotonic()
    rig.finish()
    seconds = rig.clock.monotonic() - start
    assert 19 < seconds < 23, "2,000 messages at just below 100 a second"

    rig.put(100, size=100_000)
    start = rig.clock.monotonic()
    rig.finish()
    assert 19 < rig.clock.monotonic() - start < 23, "10 MB at just below 512 KB a second"


actions = st.lists(
    st.sampled_from(["put", "put", "turn", "ack", "fail", "cut", "connect", "connect", "wait", "lose ack"]),
    max_size=60,
)


@examples(400)
@given(actions, st.integers(1, 5))
def test_whatever_happens_everything_arrives_and_first_arrivals_are_in_order_without_failures(
    script: list[str], window: int
) -> None:
    rig = Rig(window=window)
    rig.uplink.hold = True
    for action in script:
        if action == "put":
            rig.put(2)
        elif action == "turn":
            rig.turn()
        elif action == "ack":
            rig.uplink.release(count=1)
        elif action == "fail":
            rig.uplink.release(error="refused", count=1)
        elif action == "lose ack" and rig.uplink._waiting:
            rig.uplink.release(error="timeout", count=1)
        elif action == "cut":
            rig.uplink.cut()
        elif action == "connect" and not rig.uplink.connected():
            rig.uplink.connect()
        elif action == "wait":
            rig.clock.advance(31)
    rig.uplink.hold = False
    if not rig.uplink.connected():
        rig.uplink.connect()
    rig.uplink.release()
    rig.finish()
    total = rig.put_all
    assert rig.left() == 0
    assert set(rig.sent()) == set(range(total))
    first = list(dict.fromkeys(rig.sent()))
    assert first == sorted(first), "no batch overtakes an older one on its first way"


def test_waiting_for_the_end_ends_with_the_last_acknowledgement() -> None:
    rig = Rig()
    rig.uplink.connect()
    rig.put(3)
    assert not rig.lane.wait_empty(0)
    rig.turn()
    assert rig.lane.wait_empty(0)


@pytest.mark.parametrize("connected", [True, False])
def test_a_refusal_is_logged_but_a_lost_connection_is_not_blamed_on_a_batch(
    connected: bool, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    rig.uplink.connect()
    rig.uplink.hold = True
    rig.put(1)
    rig.turn()
    if connected:
        rig.uplink.release(error="not authorized")
    else:
        rig.uplink.cut()
    rig.turn()
    assert ("not authorized" in caplog.text) is connected
    assert bool(caplog.text) is connected
