"""Measures round trips through the broker, a rule and a Lambda function, and by them the cloud's clock."""

from __future__ import annotations

import threading
from collections import deque
from typing import Callable, Mapping, NamedTuple, Sequence

from iort_agent.common.state import ClockOffset, RoundTrips
from iort_agent.common.threads import Clock, Pace
from iort_agent.lanes import PingConfig
from iort_agent.mqtt.rate_limiter import STEADY
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.catalog.streams import RTT_FIELDS, RTT_STREAM
from iort_contract.limits import CLOCK_MAX_UNCERTAINTY_MS, ContractError, Value
from iort_contract.messages.live import decode_pong, encode_ping
from iort_contract.topics import BROKER, PING, PONG, RULE, parse_topic

TIMEOUT_S = 10.0
# How often a ping measures the clock offset if round trips through a rule are not measured; more often until
# the first one came back.
CLOCK_EVERY_S, CLOCK_FIRST_EVERY_S = 30.0, 1.0
# The size of a ping without padding, at most.
_ENVELOPE_BYTES = 100
# Percentiles are of the newest round trips, so that a run of weeks needs no more memory.
_KEPT = 20_000

# Takes a round trip through a rule: monotonic times of sending and receiving, and the cloud's stamp.
OnStamp = Callable[[float, float, int], None]
# Takes a sample, which is recorded only.
Record = Callable[[str, int, Mapping[str, Value]], None]


class _Path:
    def __init__(self, ping: str, pong: str) -> None:
        self.ping, self.pong = ping, pong
        self.sent = self.received = self.lost = 0
        self.rtts_ms: deque[float] = deque(maxlen=_KEPT)
        # Ping id -> monotonic time of sending, the oldest first.
        self.waiting: dict[int, float] = {}

    def report(self) -> RoundTrips:
        percentiles = (percentile(self.rtts_ms, percent) for percent in (50, 95))
        return RoundTrips(self.sent, self.received, self.lost, *percentiles)


class Pings:
    """Sends pings, takes pongs, and emits each round trip as a sample of `RTT_STREAM`.

    ``on_stamp`` gets every round trip through a rule. If none is measured, one every `CLOCK_EVERY_S` is made
    for the clock offset. ``held_back`` counts the pings that the rate limiter did not let through."""

    def __init__(self, link: Link, config: PingConfig, *, emit: Record, on_stamp: OnStamp) -> None:
        self._link, self._clock, self._uplink = link, link.clock, link.uplink
        self._emit, self._on_stamp = emit, on_stamp
        self._rate_hz, self._names = config.rate_hz, config.paths
        self._padding = "x" * config.padding_bytes
        self._changed = threading.Event()
        self._lock = threading.Condition()
        self.held_back = 0
        self._next_id = 0
        self._paths: dict[str, _Path] = {}
        self._clock_every_s, self._clock_due = CLOCK_FIRST_EVERY_S, self._clock.monotonic()
        for name in dict.fromkeys([*config.paths, RULE]):
            # The broker returns the ping itself; the cloud answers on a topic of its own.
            lane = PING if name == BROKER else PONG
            path = self._paths[name] = _Path(link.topic(PING, name), link.topic(lane, name))
            self._uplink.subscribe(path.pong, self._on_pong)

    def run(self, stop: threading.Event) -> None:
        """Send until ``stop`` is set. The paths take turns, so that none measures the others' load."""
        while True:
            self._changed.clear()
            if stop.is_set():
                return
            rate_hz, turn = self._rate_hz, 0
            pace = Pace(self._clock, stop)
            while rate_hz and rate_hz == self._rate_hz and pace.until(turn / (rate_hz * len(self._names))):
                self.send(self._names[turn % len(self._names)])
                turn += 1
            if not rate_hz:
                self._clock.wait(self._changed, None)

    def set_rate(self, rate_hz: float) -> None:
        """Use another rate, from the next ping on."""
        self._rate_hz = rate_hz
        self._changed.set()

    def wake(self) -> None:
        """Let `run` check ``stop``."""
        self._changed.set()

    def send(self, name: str) -> bool:
        """Send one ping, if the answer can come back and the rate limiter allows it; whether it was sent."""
        path = self._paths[name]
        if not self._uplink.subscribed(path.pong):
            return False
        if not self._link.rate_limiter.may_go(STEADY, path.ping, _ENVELOPE_BYTES + len(self._padding)):
            self.held_back += 1
            return False
        with self._lock:
            ping_id = self._next_id
            self._next_id += 1
            path.sent += 1
            payload = encode_ping(ping_id, self._clock.now_us(), self._padding)
            path.waiting[ping_id] = self._clock.monotonic()
        # A ping that is not written counts as lost later.
        self._link.publish(path.ping, payload, qos=0)
        return True

    def tick(self) -> None:
        """Count late pings as lost, and send a ping for the clock offset if one is due."""
        now = self._clock.monotonic()
        self._expire(now - TIMEOUT_S)
        measured = self._rate_hz and RULE in self._names
        if not measured and now >= self._clock_due and self.send(RULE):
            self._clock_due = now + self._clock_every_s

    def close(self, timeout_s: float) -> None:
        """Wait for the last answers, then count the missing ones as lost."""
        if self._rate_hz and self._uplink.connected():
            with self._lock:
                self._lock.wait_for(lambda: not any(p.waiting for p in self._paths.values()), timeout_s)
        self._expire(float("inf"))

    def report(self) -> dict[str, RoundTrips]:
        """The round trips over each path so far."""
        with self._lock:
            return {name: path.report() for name, path in self._paths.items()}

    def _on_pong(self, message: MqttMessage) -> None:
        name = parse_topic(message.topic).name
        path = self._paths[name]
        try:
            pong = decode_pong(message.payload)
        except ContractError:
            return  # from another client that may publish there
        with self._lock:
            sent = path.waiting.pop(pong.id, None)
            if sent is None:
                return  # already counted as lost, or a second answer
            rtt_ms = round((message.at - sent) * 1000, 3)
            path.received += 1
            path.rtts_ms.append(rtt_ms)
            self._lock.notify_all()
        if name == RULE and pong.received_ms is not None:
            self._clock_every_s = CLOCK_EVERY_S
            self._on_stamp(sent, message.at, pong.received_ms)
        if not self._rate_hz or name not in self._names:
            return
        values: dict[str, Value] = dict.fromkeys(RTT_FIELDS.values())
        values[RTT_FIELDS[name]] = rtt_ms
        self._emit(RTT_STREAM, self._clock.now_us(), values)

    def _expire(self, before: float) -> None:
        with self._lock:
            for path in self._paths.values():
                late = [ping_id for ping_id, sent in path.waiting.items() if sent < before]
                path.lost += len(late)
                for ping_id in late:
                    del path.waiting[ping_id]


def percentile(values: Sequence[float], percent: float) -> float | None:
    """The percentile by nearest rank; None without values."""
    if not values:
        return None
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)
    return ordered[max(0, int(rank) - 1)]


# A rule's timestamp() truncates to whole milliseconds.
_STAMP_MS = 0.5
# The drift of two oscillators. It makes an old narrow estimate worse than a new wide one.
_DRIFT_MS_PER_S = 0.05


class _Measured(NamedTuple):
    at: float
    cloud_minus_monotonic_ms: float
    half_trip_ms: float

    def uncertainty_ms(self, now: float) -> float:
        return self.half_trip_ms + _STAMP_MS + (now - self.at) * _DRIFT_MS_PER_S


class OffsetEstimator:
    """The cloud's clock minus the robot's, by the best round trip so far through a rule that stamps pings.

    Cristian's method: the stamp was made between sending and receiving, so the middle of the two is wrong by
    at most half the round trip. The offset is kept against the monotonic clock, so that it stays right when
    the wall clock is set. Safe to use from several threads.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._best: _Measured | None = None

    def add(self, sent: float, received: float, stamp_ms: int) -> None:
        """Take a round trip: the monotonic times of sending and receiving, and the cloud's stamp."""
        half_trip_ms = (received - sent) * 500
        new = _Measured(received, stamp_ms + _STAMP_MS - sent * 1000 - half_trip_ms, half_trip_ms)
        with self._lock:
            if self._best is None or _replaces(new, self._best):
                self._best = new

    def estimate(self) -> ClockOffset | None:
        """The offset now; None before the first round trip."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        wall_minus_monotonic_ms = self._clock.now_us() / 1000 - now * 1000
        return ClockOffset(
            round(best.cloud_minus_monotonic_ms - wall_minus_monotonic_ms, 3),
            round(best.uncertainty_ms(now), 3),
        )

    def known(self) -> ClockOffset | None:
        """The offset, if its uncertainty is at most `iort_contract.CLOCK_MAX_UNCERTAINTY_MS`."""
        found = self.estimate()
        return found if found is not None and found.uncertainty_ms <= CLOCK_MAX_UNCERTAINTY_MS else None

    def known_us(self) -> int | None:
        """The offset of `known` in microseconds, computed fast enough for every live message."""
        best = self._best
        if best is None:
            return None
        now = self._clock.monotonic()
        if best.uncertainty_ms(now) > CLOCK_MAX_UNCERTAINTY_MS:
            return None
        return round((best.cloud_minus_monotonic_ms + now * 1000) * 1000) - self._clock.now_us()


def _replaces(new: _Measured, old: _Measured) -> bool:
    """Whether the new one is narrower now, or contradicts the old one: the computer slept, which stops its
    monotonic clock, or the cloud's clock was set."""
    apart_ms = abs(new.cloud_minus_monotonic_ms - old.cloud_minus_monotonic_ms)
    new_ms, old_ms = new.uncertainty_ms(new.at), old.uncertainty_ms(new.at)
    return new_ms <= old_ms or apart_ms > new_ms + old_ms
