"""The live lane sends what its viewers ask for: full rate while somebody looks, next to nothing else."""

from __future__ import annotations

import pytest

from iort_agent.lanes import RuntimeSettings
from iort_agent.lanes.live import LiveLane
from iort_agent.lanes.viewers import Viewers
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.limits import LIVE_MIN_RATE_HZ
from iort_contract.messages.live import MAX_VIEWERS, Lease, LiveSample, decode_live, encode_lease, lease_topic
from iort_contract.messages.shadow import ALWAYS, WATCHED
from testkit.agent import Loopback, ManualClock, link_of

BROKER, DIRECT = "live/iort/car1/vesc", "$aws/rules/iort_live/live/iort/car1/vesc"
LEASES = lease_topic("car1", "iort")


class Rig:
    def __init__(self, *, when: str = WATCHED, rate_hz: float = 10, to_broker: bool = False) -> None:
        self.clock = ManualClock()
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.uplink.connect()
        link = link_of(self.uplink, self.clock)
        self.lane = LiveLane(link, boot="0123456789abcdef", rate_hz=rate_hz, offset_us=lambda: None)
        settings = RuntimeSettings(True, True, rate_hz, 0, "info", when)
        self.viewers = Viewers(link, self.lane, settings, to_broker=to_broker)

    def lease(
        self, viewer: str, rate_hz: float = 10, lease_ms: int = 15_000, *, broker: bool = False
    ) -> None:
        self.uplink.deliver(LEASES, encode_lease(Lease(viewer * 8, rate_hz, lease_ms, broker)))
        self.dispatcher.run_pending()

    def drive(self, seconds: float, *, every_s: float = 0.02, fault: int = 0) -> list[LiveSample]:
        """What is sent while samples come."""
        before = len(self.uplink.published)
        for i in range(round(seconds / every_s)):
            self.lane.offer("vesc", self.clock.now_us(), {"n": i, "fault_code": fault})
            self.dispatcher.run_pending()
            self.viewers.tick()
            self.lane.tick()
            self.clock.advance(every_s)
        return [decode_live(m.payload) for m in self.uplink.published[before:]]

    def topics(self, since: int = 0) -> set[str]:
        return {message.topic for message in self.uplink.published[since:]}


def test_without_a_viewer_a_message_in_ten_seconds_goes_to_the_broker() -> None:
    rig = Rig()
    sent = rig.drive(60)
    assert 6 <= len(sent) <= 7
    assert {live.next_ms for live in sent} == {10_000}
    assert rig.topics() == {BROKER}


def test_a_change_of_the_fault_is_sent_at_once_without_a_viewer() -> None:
    rig = Rig()
    rig.drive(3)
    assert [live.sample["fault_code"] for live in rig.drive(3, fault=5)] == [5]
    assert [live.sample["fault_code"] for live in rig.drive(3, fault=0)] == [0]


def test_a_lease_sends_the_newest_sample_at_once_and_then_the_rate() -> None:
    rig = Rig()
    rig.drive(5)
    before = len(rig.uplink.published)
    rig.lease("a")
    (message,) = rig.uplink.published[before:]
    live = decode_live(message.payload)
    assert (message.topic, live.sample["n"], live.next_ms) == (DIRECT, 249, 100)
    assert 95 <= len(rig.drive(10)) <= 101


def test_a_sample_that_was_sent_is_shown_again_to_who_looks_now() -> None:
    rig = Rig()
    rig.drive(0.02)
    rig.lease("a")
    assert [decode_live(m.payload).sample["n"] for m in rig.uplink.published] == [0, 0]
    rig.clock.advance(3)
    rig.lease("b")
    assert len(rig.uplink.published) == 2, "an old one is no present"


def test_a_lease_ends_by_itself_and_says_when_the_next_message_comes() -> None:
    rig = Rig()
    rig.lease("a", lease_ms=2_000)
    sent = rig.drive(20)
    assert 19 <= len([live for live in sent if live.next_ms == 100]) <= 22
    idle = [live for live in sent if live.next_ms == 10_000]
    assert len(idle) == 2
    first, second = ((live.sent_us - sent[0].sent_us) / 1e6 for live in idle)
    assert 2.0 <= first <= 2.2, "at once, before a viewer takes the stream for silent"
    assert 9.5 <= second - first <= 10.1
    assert rig.viewers.count() == 0


def test_a_lease_of_no_time_ends_the_lease() -> None:
    rig = Rig()
    rig.lease("a")
    rig.drive(1)
    rig.lease("a", lease_ms=0)
    assert len(rig.drive(9)) == 1


def test_the_fastest_viewer_counts_within_the_cars_own_rate() -> None:
    rig = Rig(rate_hz=5)
    rig.lease("a", 1)
    assert 9 <= len(rig.drive(10)) <= 12
    rig.lease("b", 10, lease_ms=10_000)
    assert 48 <= len(rig.drive(10)) <= 52
    rig.lease("a", 1)
    assert 4 <= len(rig.drive(4)) <= 6, "the slow one still looks"


def test_a_viewer_who_asks_for_little_does_not_delay_the_alert_rules() -> None:
    rig = Rig()
    rig.lease("a", LIVE_MIN_RATE_HZ)
    mark = len(rig.uplink.published)
    sent = []
    for _ in range(6):
        sent += rig.drive(10)
        rig.lease("a", LIVE_MIN_RATE_HZ)
    assert 6 <= len(sent) <= 7
    assert {live.next_ms for live in sent} == {10_000}
    assert rig.topics(mark) == {BROKER}


def test_everything_goes_to_the_broker_while_a_viewer_listens_there() -> None:
    rig = Rig()
    rig.drive(1)
    rig.lease("a")
    rig.drive(1)
    assert rig.topics() == {BROKER, DIRECT}
    mark = len(rig.uplink.published)
    rig.lease("b", lease_ms=3_000, broker=True)
    rig.drive(2.9)
    assert rig.topics(mark) == {BROKER}
    rig.drive(0.5)
    mark = len(rig.uplink.published)
    rig.drive(1)
    assert rig.topics(mark) == {DIRECT}


@pytest.mark.parametrize(("to_broker", "topics"), [(False, {BROKER, DIRECT}), (True, {BROKER})])
def test_always_sends_at_the_full_rate_without_a_viewer(to_broker: bool, topics: set[str]) -> None:
    rig = Rig(when=ALWAYS, to_broker=to_broker)
    assert 95 <= len(rig.drive(10)) <= 101
    assert rig.topics() == topics


def test_the_setting_can_be_changed_at_run_time() -> None:
    rig = Rig()
    rig.viewers.apply(RuntimeSettings(True, True, 10, 0, "info", ALWAYS))
    assert 95 <= len(rig.drive(10)) <= 101
    rig.viewers.apply(RuntimeSettings(True, True, 10, 0, "info", WATCHED))
    assert len(rig.drive(9)) == 1


def test_a_switched_off_lane_has_nothing_for_a_viewer() -> None:
    rig = Rig()
    rig.drive(1)
    rig.lane.enabled = False
    mark = len(rig.uplink.published)
    rig.lease("a")
    assert rig.uplink.published[mark:] == []


def test_a_robot_that_may_not_hear_its_viewers_sends_always(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    monkeypatch.setattr(rig.uplink, "subscribed", lambda _: False)
    assert len(rig.drive(4.5)) == 1, "the broker may still answer"
    rig.drive(1)
    assert 95 <= len(rig.drive(10)) <= 101
    rig.uplink.cut()
    rig.drive(10)
    assert len(rig.uplink.published) < 120


def test_viewers_beyond_the_most_share_a_lease() -> None:
    rig = Rig()
    for i in range(MAX_VIEWERS):
        rig.uplink.deliver(LEASES, encode_lease(Lease(f"{i:08x}", 0.1, 15_000)))
    rig.lease("a", 1)
    rig.lease("b", 5)
    assert rig.viewers.count() == MAX_VIEWERS + 1
    assert 49 <= len(rig.drive(10)) <= 52
    # One ends, and the other one looks on.
    rig.lease("b", lease_ms=0)
    rig.lease("a", 1)
    assert rig.drive(10)
    rig.drive(10)
    assert rig.viewers.count() == 0


def test_what_is_no_lease_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.uplink.deliver(LEASES, b'{"v": 1, "viewer": "x"}')
    rig.dispatcher.run_pending()
    assert rig.viewers.count() == 0
    assert "rate_hz must be a number, got None" in caplog.text


def test_a_slow_stream_is_sent_before_it_is_old() -> None:
    rig = Rig()
    sent = rig.drive(61, every_s=9.99)
    assert len(sent) == 6, "a sample just before its turn waits a second for a newer one, not five"
