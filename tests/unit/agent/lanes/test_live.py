"""The live lane: only the newest sample, at once, at most at the rate, and never late."""

from __future__ import annotations

import pytest

from iort_agent.lanes.live import Demand, LiveLane
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.limits import MAX_MESSAGE_BYTES
from iort_contract.messages.live import LiveSample, decode_live
from testkit.agent import Loopback, ManualClock, link_of

T0 = 1_700_000_000_000_000


class Rig:
    def __init__(self, *, rate_hz: float = 10, connected: bool = True) -> None:
        self.clock = ManualClock(now_us=T0)
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.offset_us: int | None = None
        if connected:
            self.uplink.connect()
        self.lane = LiveLane(
            link_of(self.uplink, self.clock),
            boot="0123456789abcdef",
            rate_hz=rate_hz,
            offset_us=lambda: self.offset_us,
        )

    def offer(self, speed: float, stream: str = "vesc") -> None:
        self.lane.offer(stream, self.clock.now_us(), {"speed": speed})
        self.dispatcher.run_pending()

    def tick(self) -> None:
        self.lane.tick()
        self.dispatcher.run_pending()

    def sent(self, stream: str = "vesc") -> list[LiveSample]:
        topic = f"live/iort/car1/{stream}"
        return [decode_live(m.payload) for m in self.uplink.published if m.topic.endswith(topic)]

    def speeds(self) -> list[object]:
        return [live.sample["speed"] for live in self.sent()]


def test_the_first_sample_goes_at_once_with_both_times() -> None:
    rig = Rig()
    rig.clock.advance(5)
    rig.lane.offer("vesc", T0 + 4_990_000, {"speed": 7, "bad": float("nan")})
    (live,) = rig.sent()
    assert (live.t_us, live.sent_us, live.seq) == (T0 + 4_990_000, T0 + 5_000_000, 0)
    assert live.sample == {"speed": 7, "bad": None}
    assert rig.uplink.published[0].qos == 0


def test_50_hz_becomes_10_hz_without_waiting() -> None:
    rig = Rig()
    for i in range(500):
        rig.offer(i)
        rig.clock.advance(0.02)
    assert 95 <= len(rig.sent()) <= 101
    assert all(live.sent_us == live.t_us for live in rig.sent()), "each goes the moment it comes"
    assert [live.seq for live in rig.sent()] == list(range(len(rig.sent())))


def test_of_samples_that_come_together_the_newest_is_sent() -> None:
    rig = Rig()
    for speed in range(3):
        next_at = rig.lane.offer("vesc", rig.clock.now_us(), {"speed": speed}, more=speed < 2)
    assert rig.speeds() == [2]
    assert rig.clock.monotonic() < next_at <= rig.clock.monotonic() + 0.1


def test_another_fault_code_among_samples_that_come_together_is_sent() -> None:
    rig = Rig(rate_hz=0.1)
    rig.offer(0)
    rig.clock.advance(1)
    for code in (0, 3, 0):
        next_at = rig.lane.offer("vesc", rig.clock.now_us(), {"fault_code": code}, more=True)
    assert [live.sample.get("fault_code") for live in rig.sent()] == [None, 0]
    assert next_at == pytest.approx(rig.clock.monotonic() + 0.1), "whatever the rate is"
    rig.clock.advance(10)
    for code, more in ((0, True), (3, True), (0, False)):
        rig.lane.offer("vesc", rig.clock.now_us(), {"fault_code": code}, more=more)
    assert [live.sample.get("fault_code") for live in rig.sent()][2:] == [3], "also where the last is due"


def test_slightly_late_samples_do_not_lower_the_rate() -> None:
    rig = Rig()
    for i in range(400):
        rig.offer(i)
        rig.clock.advance(0.03 if i % 2 else 0.021)
    seconds = 400 * 0.0255
    assert len(rig.sent()) >= seconds * 10 * 0.95


def test_the_last_sample_before_a_silence_is_shown() -> None:
    rig = Rig()
    rig.offer(1)
    rig.clock.advance(0.02)
    rig.offer(2)
    rig.clock.advance(0.02)
    rig.offer(3)
    rig.tick()
    assert rig.speeds() == [1]
    rig.clock.advance(0.12)
    rig.tick()
    rig.tick()
    assert rig.speeds() == [1, 3], "the newest, once, and 2 never"


def test_only_the_newest_sample_is_kept_over_an_outage() -> None:
    rig = Rig(connected=False)
    for i in range(100):
        rig.offer(i)
        rig.clock.advance(0.02)
        rig.tick()
    rig.uplink.connect()
    rig.tick()
    assert rig.speeds() == [99]


def test_an_old_sample_is_not_sent_after_an_outage() -> None:
    rig = Rig(connected=False)
    rig.offer(1)
    rig.clock.advance(3)
    rig.uplink.connect()
    rig.tick()
    assert rig.speeds() == []


def test_a_message_being_written_delays_the_next() -> None:
    rig = Rig()
    rig.uplink.stalled = True
    for i in range(50):
        rig.offer(i)
        rig.clock.advance(0.1)
    assert rig.speeds() == [0], "a socket that stalls is not given a queue"
    rig.uplink.stalled = False
    rig.uplink.release()
    rig.dispatcher.run_pending()
    rig.offer(50)
    assert rig.speeds() == [0, 50]


def test_a_bad_sample_is_refused_and_counted() -> None:
    rig = Rig()
    rig.lane.offer("vesc", T0, {"speed": b"x"})
    rig.lane.offer("vesc", T0, {f"f{i}": "x" * 4096 for i in range(64)})
    rig.offer(1)
    assert rig.lane.refused == 2
    assert rig.speeds() == [1]


def test_a_sample_too_large_for_a_message_is_not_sent() -> None:
    rig = Rig()
    texts = {f"f{i:02}": "x" * 4096 for i in range(31)}
    rig.lane.offer("vesc", T0, {**texts, "last": ""})
    rig.dispatcher.run_pending()
    room = MAX_MESSAGE_BYTES - len(rig.uplink.published.pop().payload)
    rig.clock.advance(1)
    rig.lane.offer("vesc", T0, {**texts, "last": "x" * (room + 1)})
    rig.dispatcher.run_pending()
    assert (rig.uplink.published, rig.lane.refused) == ([], 1)
    rig.clock.advance(1)
    rig.lane.offer("vesc", T0, {**texts, "last": "x" * room})
    (message,) = rig.uplink.published
    assert len(message.payload) == MAX_MESSAGE_BYTES, "one byte more is one too many"
    rig.dispatcher.run_pending()
    assert (rig.lane.refused, rig.lane.published) == (1, 2)


def test_only_written_messages_count_as_published() -> None:
    rig = Rig()
    rig.offer(1)
    rig.uplink.verdict = lambda _: "full"
    rig.clock.advance(1)
    rig.offer(2)
    assert rig.lane.published == 1


def test_the_rate_and_the_lane_itself_can_be_changed() -> None:
    rig = Rig(rate_hz=0.1)
    rig.offer(0)
    rig.lane.follow(Demand(10))
    for i in range(1, 101):
        rig.clock.advance(0.02)
        rig.offer(i)
    assert 19 <= len(rig.sent()) <= 21, "what was due in ten seconds is due in a tenth"
    rig.lane.enabled = False
    count = len(rig.sent())
    for i in range(100):
        rig.clock.advance(0.02)
        rig.offer(i)
        rig.tick()
    assert len(rig.sent()) <= count + 1, "what was offered before"


def test_a_message_carries_the_clock_offset_if_it_is_known() -> None:
    rig = Rig()
    rig.offer(1)
    rig.offset_us = -3_600_000_000
    rig.clock.advance(1)
    rig.offer(2)
    assert [live.offset_us for live in rig.sent()] == [None, -3_600_000_000]


BROKER, DIRECT = "live/iort/car1/vesc", "$aws/rules/iort_live/live/iort/car1/vesc"


def _drive(rig: Rig, seconds: float, **values: object) -> list[str]:
    """The topics that a stream at 10 Hz is sent on."""
    before = len(rig.uplink.published)
    for _ in range(round(seconds * 10)):
        rig.lane.offer("vesc", rig.clock.now_us(), values)
        rig.dispatcher.run_pending()
        rig.clock.advance(0.1)
    return [message.topic for message in rig.uplink.published[before:]]


def test_the_first_message_and_one_in_ten_seconds_go_to_the_broker() -> None:
    topics = _drive(Rig(), 30, speed=1)
    assert [i for i, topic in enumerate(topics) if topic == BROKER] == [0, 100, 200]
    assert set(topics) == {BROKER, DIRECT}


def test_every_change_of_the_fault_code_goes_to_the_broker_at_once() -> None:
    rig = Rig()
    topics = [_drive(rig, 1, fault_code=code) for code in (0, 5, 6, 0)]
    assert [[topic == BROKER for topic in each] for each in topics] == 4 * [[True] + 9 * [False]]
    assert _drive(rig, 10.1, fault_code=5).count(BROKER) == 2, "and again while it lasts"


def test_a_lost_broker_message_is_repeated() -> None:
    rig = Rig()
    _drive(rig, 1, fault_code=0)
    rig.uplink.verdict = lambda _: "full"
    _drive(rig, 0.1, fault_code=5)
    rig.uplink.verdict = lambda _: None
    assert _drive(rig, 0.2, fault_code=5) == [BROKER, DIRECT]


def test_an_urgent_stream_is_sent_to_the_broker_at_the_fastest_rate_however_slow_the_lane_is() -> None:
    rig = Rig(rate_hz=0.1)
    for i in range(100):
        rig.lane.offer("drive", rig.clock.now_us(), {"seq": i}, urgent=True)
        rig.clock.advance(0.05)
    assert len(rig.sent("drive")) == pytest.approx(50, abs=1)
    assert {message.topic for message in rig.uplink.published} == {"live/iort/car1/drive"}
    rig.clock.advance(0.2)
    rig.tick()
    assert rig.sent("drive")[-1].sample == {"seq": 99}


def test_a_fault_shorter_than_the_period_is_sent_and_the_rate_stays() -> None:
    rig = Rig(rate_hz=0.1)
    topics = [_drive(rig, seconds, fault_code=code) for seconds, code in ((1, 0), (0.5, 5), (18.6, 0))]
    assert topics[:2] == [[BROKER], [BROKER]]
    assert [live.sample["fault_code"] for live in rig.sent()] == [0, 5, 0, 0, 0]
    assert [round((live.sent_us - T0) / 1e6, 1) for live in rig.sent()] == [0, 1, 1.5, 9, 19]


def test_the_last_fault_of_a_silent_stream_is_sent() -> None:
    rig = Rig(rate_hz=0.1)
    _drive(rig, 0.1, fault_code=0)
    rig.clock.advance(-0.05)
    _drive(rig, 0.1, fault_code=5)
    rig.tick()
    assert [live.sample["fault_code"] for live in rig.sent()] == [0, 5]
    assert rig.uplink.published[-1].topic == BROKER


def test_changing_faults_are_limited_to_the_fastest_rate() -> None:
    rig = Rig(rate_hz=1)
    for i in range(1000):
        rig.lane.offer("vesc", rig.clock.now_us(), {"fault_code": i % 7})
        rig.dispatcher.run_pending()
        rig.clock.advance(0.01)
    assert len(rig.sent()) <= 101


def test_a_lost_fault_is_repeated_before_its_slow_turn() -> None:
    rig = Rig(rate_hz=0.1)
    _drive(rig, 1, fault_code=0)
    rig.uplink.verdict = lambda _: "full"
    _drive(rig, 0.1, fault_code=5)
    rig.uplink.verdict = lambda _: None
    assert _drive(rig, 1, fault_code=5) == [BROKER]


def test_a_fault_of_nan_is_not_a_change() -> None:
    topics = [topic for _ in range(3) for topic in _drive(Rig(), 1, fault_code=float("nan"))]
    assert topics.count(BROKER) == 3
