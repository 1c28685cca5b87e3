"""The lanes together on one connection, by simulated time: recordings first, live shares the rest fairly,
and AWS' limits hold in every second."""

from __future__ import annotations

import bisect
import logging
import random
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from iort_agent.agent import Agent, make_status
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config
from iort_agent.lanes import LiveConfig, PingConfig, RecordConfig
from iort_agent.lanes.record import Production, Rate, too_many
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.rate_limiter import URGENT, RateLimiter
from iort_agent.runtime import Runtime
from iort_agent.status import render
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.shadow import ALWAYS
from iort_contract.topics import BROKER, LIVE
from testkit.agent import Loopback, ManualClock, MemorySpool, Published
from tests.unit.agent.test_agent import Script

T0 = 1_700_000_000_000_000
TICK_MS = 200
# The time until the rates are those of the last seconds.
SETTLE_S = 4


class Sent(NamedTuple):
    at: float
    topic: str
    size: int


class Topic(NamedTuple):
    hz: float
    values: Callable[[], Mapping[str, Any]]


def named(count: int) -> Script:
    """A source that only names its streams."""
    return Script(lambda *_: None, *(f"topic{i:03}" for i in range(count)))


class Drive:
    """A real agent whose threads are called in turn, every millisecond."""

    def __init__(self, topics: Mapping[str, Topic], **settings: Any) -> None:
        self.topics = topics
        self.clock = ManualClock(now_us=T0)
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.uplink.hold = True
        self.uplink.verdict = self._sees
        self.spool = MemorySpool(max_bytes=10**9)
        live = LiveConfig(when=ALWAYS)
        config = replace(Config("car1", "host", Path(), Path(), (), live=live), **settings)
        self.agent = Agent(config, uplink=self.uplink, spool=self.spool, clock=self.clock)
        self.runtime = Runtime(self.agent)
        self.sent: list[Sent] = []
        self.rtt_s = 0.05
        self._acks: list[float] = []
        self._ms = 0
        self._record_due = 0.0
        self.uplink.connect()

    def _sees(self, message: Published) -> None:
        at = self.clock.monotonic()
        self.sent.append(Sent(at, message.topic, len(message.topic) + len(message.payload)))
        if message.qos:
            self._acks.append(at + self.rtt_s)

    def run(self, seconds: float, *, sources: bool = True, pings_hz: float = 0) -> None:
        for _ in range(round(seconds * 1000)):
            self._ms += 1
            self.clock.advance(0.001)
            if sources:
                self._offer()
            if self._is_due(pings_hz):
                self.agent.pings.send(BROKER)
            if self._ms % TICK_MS == 0:
                self.runtime.tick()
            if self._ms % 1000 == 0:
                self.runtime.tick_slowly()
            ready = bisect.bisect_right(self._acks, self.clock.monotonic())
            if ready:
                del self._acks[:ready]
                self.uplink.release(count=ready)
            self.dispatcher.run_pending()
            self._record()

    def _is_due(self, hz: float, shift_ms: int = 0) -> bool:
        ms = self._ms - shift_ms
        return ms > 0 and ms * hz // 1000 > (ms - 1) * hz // 1000

    def _offer(self) -> None:
        for i, (stream, topic) in enumerate(self.topics.items()):
            # Each stream has its own milliseconds.
            if self._is_due(topic.hz, 7 * i):
                self.agent.streams.emit(stream, self.clock.now_us(), topic.values())

    def _record(self) -> None:
        lane = self.agent.record
        if lane._wake.is_set() or self.clock.monotonic() >= self._record_due:
            lane._wake.clear()
            wait_s = lane.step()
            self._record_due = float("inf") if wait_s is None else self.clock.monotonic() + wait_s

    def status(self) -> dict[str, Any]:
        return asdict(make_status(self.agent))

    def cut(self) -> None:
        self._acks.clear()
        self.uplink.cut()

    def backlog(self) -> int:
        return self.spool.backlog().batches

    def live(self, seconds: float) -> dict[str, int]:
        """The live messages of each stream in the last seconds."""
        found = dict.fromkeys(self.topics, 0)
        for sent in self.sent:
            levels = sent.topic.split("/")
            if levels[-4] == LIVE and sent.at >= self.clock.monotonic() - seconds:
                found[levels[-1]] += 1
        return found

    def end(self) -> None:
        """Deliver everything; check that all arrived and that no second exceeded the limits."""
        self.agent.streams.flush()
        self.run(2, sources=False)
        assert self.backlog() == 0
        taken = {name: one.samples for name, one in make_status(self.agent).streams.items()}
        arrived = dict.fromkeys(taken, 0)
        for message in self.uplink.published:
            if message.topic.startswith("$aws/rules/iort_record/"):
                batch = decode_batch(message.payload)
                arrived[message.topic.split("/")[-1]] += len(batch.times_us)
        assert arrived == taken
        self.check_limits()

    def check_limits(self) -> None:
        """The most in any second that begins with a publish, both ends included."""
        times, total = [sent.at for sent in self.sent], 0
        for i, first in enumerate(self.sent):
            end = bisect.bisect_right(times, first.at + 1)
            total = sum(sent.size for sent in self.sent[i:end])
            assert (end - i <= 100, total <= 512 * 1024) == (True, True), f"{end - i} with {total} bytes"


def topics(count: int, hz: float, values: Callable[[], Mapping[str, Any]] = lambda: {"x": 1.5}) -> Any:
    return {f"topic{i:03}": Topic(hz, values) for i in range(count)}


@pytest.mark.parametrize(
    ("count", "hz", "least_live_hz", "most_live_hz"),
    [(10, 20, 7.5, 8.0), (50, 20, 0.75, 0.8), (10, 200, 7.5, 8.0), (80, 5, 0.075, 0.13)],
)
def test_recordings_go_first_and_live_shares_the_rest(
    count: int, hz: float, least_live_hz: float, most_live_hz: float
) -> None:
    drive = Drive(topics(count, hz))
    drive.run(SETTLE_S)
    drive.run(15)
    assert drive.backlog() <= 3, "but for what is on its way"
    live = drive.live(15).values()
    assert max(live) - min(live) <= 1, "no stream is favoured"
    mean_hz = sum(live) / count / 15
    assert least_live_hz <= mean_hz <= most_live_hz
    tempo = drive.status()["lanes"]["live"]
    assert (tempo["asked_hz"], tempo["slowed"]) == (10, True)
    assert tempo["effective_hz"] == pytest.approx(mean_hz, rel=0.15)
    drive.end()


def test_few_topics_get_their_rate_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    drive = Drive(topics(6, 50))
    drive.run(SETTLE_S)
    drive.run(10)
    assert set(drive.live(10).values()) <= {99, 100, 101}
    assert drive.status()["lanes"]["live"]["effective_hz"] == 10
    assert "SLOWED" not in render(make_status(drive.agent))
    assert not caplog.messages
    drive.end()


def test_slow_streams_use_only_their_own_rate() -> None:
    rates = [1000, 100, 50, 20, 20, 10, 10, 10, 5, 5, *[50] * 8, 1, 1, 0.5, 0.5]
    drive = Drive({f"topic{i:03}": Topic(hz, lambda: {"x": 1.5}) for i, hz in enumerate(rates)})
    drive.run(SETTLE_S)
    drive.run(20)
    live = list(drive.live(20).values())
    assert live[-4:] == [20, 20, 10, 10]
    fast = live[:8] + live[10:18]
    assert max(fast) - min(fast) <= 4
    assert min(fast) >= 20 * 3.5
    assert drive.status()["lanes"]["live"]["effective_hz"] == pytest.approx(min(fast) / 20, rel=0.1)
    drive.end()


def test_bytes_are_shared_like_publishes() -> None:
    chance = random.Random(1)
    numbers = Drive(topics(10, 20, lambda: {f"f{i:03}": chance.random() for i in range(100)}))
    texts = Drive(topics(10, 20, lambda: {f"f{i}": "x" * 4000 for i in range(8)}))
    for drive, least_hz in ((numbers, 4), (texts, 1)):
        drive.run(SETTLE_S)
        drive.run(4)
        assert drive.backlog() <= 3
        live = drive.live(4).values()
        assert max(live) - min(live) <= 1
        assert least_hz * 4 <= min(live) < 6 * 4
        drive.end()


def test_live_has_a_tenth_while_a_backlog_drains_and_its_rate_afterwards() -> None:
    drive = Drive(topics(30, 20))
    drive.run(SETTLE_S)
    drive.cut()
    drive.run(20)
    assert drive.backlog() >= 580
    drive.uplink.connect()
    drive.run(1)
    assert sum(drive.live(1).values()) >= 1, "the dashboard shows now"
    drive.run(5)
    live = drive.live(5).values()
    assert 5 * 7 <= sum(live) <= 5 * 9
    assert max(live) - min(live) <= 1
    assert drive.backlog() < 620 - 6 * 45, "the rest is the backlog's"
    drive.run(12)
    assert drive.backlog() <= 3
    drive.run(5)
    assert sum(drive.live(5).values()) >= 5 * 55
    drive.end()


def test_another_fault_code_is_sent_soon_under_any_load() -> None:
    fault = {"code": 0}
    faulty = {f"vesc{i}": Topic(20, lambda: {"fault_code": fault["code"]}) for i in range(3)}
    drive = Drive({**topics(50, 20), **faulty})
    drive.run(SETTLE_S)
    drive.cut()
    drive.run(20)
    drive.uplink.connect()
    drive.run(3)
    assert drive.backlog() > 500
    for code in (5, 0):
        fault["code"] = code
        before = len(drive.sent)
        drive.run(0.15)
        told = {sent.topic for sent in drive.sent[before:] if sent.topic.startswith("live/")}
        assert {f"live/iort/car1/{stream}" for stream in faulty} <= told
        drive.run(1)
    drive.check_limits()


def test_recordings_come_before_pings_and_pings_before_live() -> None:
    drive = Drive(topics(50, 20), ping=PingConfig(rate_hz=20, paths=(BROKER,)))
    drive.run(SETTLE_S, pings_hz=20)
    before = drive.status()["pings"][BROKER]["sent"]
    held_back = drive.status()["lanes"]["ping"]["held_back"]
    drive.run(10, pings_hz=20)
    assert drive.status()["pings"][BROKER]["sent"] - before == 200
    assert drive.status()["lanes"]["ping"]["held_back"] == held_back
    assert 10 * 15 <= sum(drive.live(10).values()) <= 10 * 20
    assert drive.backlog() <= 3
    drive.run(10, pings_hz=100)
    assert drive.status()["lanes"]["ping"]["held_back"] > 500
    assert drive.backlog() <= 10, "recordings go before pings, too"
    drive.end()


def test_unacknowledged_batches_fill_a_slow_network() -> None:
    drive = Drive(topics(50, 20))
    drive.rtt_s = 0.5
    drive.run(15)
    assert drive.backlog() <= 2 * 50
    assert drive.status()["alarms"] == []
    drive.end()


def test_too_much_for_one_connection_raises_an_alarm_with_advice(caplog: pytest.LogCaptureFixture) -> None:
    drive = Drive(topics(120, 2))
    drive.run(9)
    assert drive.status()["alarms"] == []
    drive.run(16)
    (alarm,) = drive.status()["alarms"]
    assert "batches wait, 1" in alarm
    assert "the limit allows 90 batches/s" in alarm
    assert "record fewer topics" in alarm
    assert f"ALARM     {alarm}" in render(make_status(drive.agent))
    assert len([text for text in caplog.messages if text.startswith("record: more is recorded")]) == 1
    assert 1 <= sum(drive.live(5).values()) <= 10, "next to nothing is left"
    drive.check_limits()
    drive.run(40, sources=False)
    assert drive.status()["alarms"] == []


def test_the_alarm_has_the_reason_of_a_broker_that_refuses() -> None:
    drive = Drive(topics(10, 20))
    drive.uplink.verdict = lambda message: "the broker says quota exceeded" if message.qos else None
    drive.run(30)
    (alarm,) = drive.status()["alarms"]
    assert alarm.endswith("; the broker says quota exceeded")


def test_the_alarm_tells_a_slow_network_from_the_limit() -> None:
    drive = Drive(topics(10, 20))
    drive.rtt_s = 20
    drive.run(30)
    (alarm,) = drive.status()["alarms"]
    assert "the network is too slow" in alarm


def test_a_slowed_lane_is_logged_once_and_shown(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    drive = Drive(topics(30, 20))
    drive.run(SETTLE_S)
    drive.cut()
    drive.run(8)
    drive.uplink.connect()
    drive.run(15)
    status = make_status(drive.agent)
    effective = status.lanes.live.effective_hz
    told = f"10 of up to 10 Hz for nobody, SLOWED to {effective:g} Hz a stream by AWS' limit"
    assert told in render(status)
    assert 1.5 < status.streams["topic007"].live_hz < 2.2
    drive.topics = topics(1, 20)
    drive.run(15)
    assert "SLOWED" not in render(make_status(drive.agent))
    told_of = [(r.levelno, r.message[:15]) for r in caplog.records if r.message.startswith("live: ")]
    assert told_of == [(logging.WARNING, "live: slowed do"), (logging.INFO, "live: up to 10 ")]


def test_overdrafts_are_paid_back_and_end_at_the_limit() -> None:
    clock = ManualClock()
    rate_limiter = RateLimiter(clock)
    gone = 0
    for _ in range(1000):
        while rate_limiter.may_go(URGENT, "t", 10):
            rate_limiter.spend("t", b"x" * 10)
            gone += 1
        clock.advance(0.001)
    assert gone <= 100
    assert not rate_limiter.may_go(URGENT, "t", 10)
    assert rate_limiter.record("t", b"x") > 0
    clock.advance(1)
    assert rate_limiter.record("t", b"x") == 0


def test_production_is_a_mean_of_seconds_and_growth_needs_a_connection() -> None:
    for connected in (True, False):
        production, made, sent = Production(), 0.0, 0.0
        for second in range(100):
            made, sent = made + 100, sent + 80
            production.note(
                float(second),
                made=Rate(made, made * 1000),
                sent=Rate(sent, sent * 1000),
                backlog=made - sent,
                connected=connected,
            )
        assert production.made == (100, 100_000)
        assert production.sent == (80, 80_000)
        assert production.behind == connected


@pytest.mark.parametrize(
    ("streams", "batch_s", "made"),
    [(90, 1.0, None), (91, 1.0, 91), (45, 0.5, None), (46, 0.5, 92), (23, 0.3, 92), (20, 0.0, None)],
)
def test_too_many_streams_are_recognized_from_the_configuration(
    streams: int, batch_s: float, made: int | None
) -> None:
    record = RecordConfig(batch_s=batch_s)
    config = Config("car1", "host", Path(), Path(), (named(streams),), record=record)
    problem = too_many(config.sources, config.record)
    assert (problem is None) == (made is None)
    assert made is None or f"up to {made} batches a second, and one connection takes 90" in str(problem)
    assert too_many(config.sources, replace(record, enabled=False)) is None


def test_too_many_streams_are_logged_at_the_start(caplog: pytest.LogCaptureFixture) -> None:
    clock = SystemClock()
    agent = Agent(
        Config("car1", "host", Path(), Path(), (named(91),)),
        uplink=Loopback(clock, Dispatcher()),
        spool=MemorySpool(max_bytes=10**6),
        clock=clock,
    )
    # The source gives no sample, which is a failure by itself.
    assert Runtime(agent).run(drain_s=10) == 1
    assert "record: 91 streams are up to 91 batches a second" in caplog.text
    assert "record fewer topics" in caplog.text
