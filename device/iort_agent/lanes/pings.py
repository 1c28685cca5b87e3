"""Measures round trips: through the broker, through a rule, through a Lambda function."""

from __future__ import annotations

import threading
from collections import deque
from typing import Callable, NamedTuple, Sequence

from iort_agent.clock import Clock, Pace
from iort_agent.errors import UplinkError
from iort_agent.mqtt.uplink import Message, Uplink
from iort_agent.rate_limiter import STEADY, Allowance
from iort_agent.sources import Emit
from iort_contract.catalog.streams import RTT_FIELDS, RTT_STREAM
from iort_contract.limits import ContractError, Value
from iort_contract.messages.live import decode_pong, encode_ping
from iort_contract.topics import BROKER, PING, PONG, RULE, build_topic, parse_topic

TIMEOUT_S = 10.0
# Where round trips through a rule are not measured, a ping now and then still finds the clock's offset,
# and more often until one came back.
CLOCK_EVERY_S, CLOCK_FIRST_EVERY_S = 30.0, 1.0
# A ping without its padding, at most.
_ENVELOPE_BYTES = 100
# Percentiles are of the newest so many, so that a run of weeks does not grow.
_KEPT = 20_000


class PathReport(NamedTuple):
    """The round trips over one path, in milliseconds."""

    sent: int
    received: int
    lost: int
    p50_ms: float | None
    p95_ms: float | None


class _Path:
    def __init__(self, ping: str, pong: str) -> None:
        self.ping = ping
        self.pong = pong
        self.sent = self.received = self.lost = 0
        self.rtts_ms: deque[float] = deque(maxlen=_KEPT)
        # ping id -> monotonic time; the oldest first.
        self.waiting: dict[int, float] = {}


# Takes a round trip through a rule: monotonic times of sending and receiving, and the cloud's stamp.
OnStamp = Callable[[float, float, int], None]


class Pings:
    """Sends pings, takes pongs, and emits each round trip as a sample of `RTT_STREAM`.

    Every round trip through a rule is told to ``on_stamp``; where none is measured, one every
    `CLOCK_EVERY_S` is made for that alone. A ping that the connection has no room for, since recordings go
    first, is not sent, and counted in ``held_back`` alone."""

    def __init__(
        self,
        *,
        robot: str,
        namespace: str,
        paths: Sequence[str],
        rate_hz: float,
        padding_bytes: int,
        uplink: Uplink,
        clock: Clock,
        allowance: Allowance,
        emit: Emit,
        on_stamp: OnStamp,
    ) -> None:
        self._rate_hz = rate_hz
        self._changed = threading.Event()
        self._on_stamp = on_stamp
        self._padding = "x" * padding_bytes
        self._uplink = uplink
        self._clock = clock
        self._allowance = allowance
        self._emit = emit
        self._lock = threading.Condition()
        self.held_back = 0
        self._next_id = 0
        self._paths: dict[str, _Path] = {}
        self._names = list(paths)
        self._clock_every_s, self._clock_due = CLOCK_FIRST_EVERY_S, clock.monotonic()
        for name in dict.fromkeys([*paths, RULE]):
            ping = build_topic(PING, robot, name, namespace)
            # Over the broker alone the ping itself comes back; the cloud answers on a topic of its own.
            lane = PING if name == BROKER else PONG
            path = _Path(ping, build_topic(lane, robot, name, namespace))
            self._paths[name] = path
            uplink.subscribe(path.pong, self._on_pong)

    def run(self, stop: threading.Event) -> None:
        """Send until ``stop`` is set; the paths take turns, so that none measures the others' load."""
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
        """Another rate, from the next ping on."""
        self._rate_hz = rate_hz
        self._changed.set()

    def wake(self) -> None:
        """Look at `run`'s ``stop`` again: it was set."""
        self._changed.set()

    def send(self, name: str) -> bool:
        """Send one ping, if there is a connection with room and the way back is open; whether it was."""
        path = self._paths[name]
        if not self._uplink.subscribed(path.pong):
            return False
        if not self._allowance.may_go(STEADY, path.ping, _ENVELOPE_BYTES + len(self._padding)):
            self.held_back += 1
            return False
        with self._lock:
            ping_id = self._next_id
            self._next_id += 1
            path.sent += 1
            payload = encode_ping(ping_id, self._clock.now_us(), self._padding)
            path.waiting[ping_id] = self._clock.monotonic()
        self._allowance.spend(path.ping, payload)
        self._uplink.publish(path.ping, payload, qos=0, done=_ignore)
        return True

    def tick(self) -> None:
        """Count as lost what has not come back in time, and send what finds the clock's offset."""
        now = self._clock.monotonic()
        self._expire(now - TIMEOUT_S)
        measured = self._rate_hz and RULE in self._names
        if not measured and now >= self._clock_due and self.send(RULE):
            self._clock_due = now + self._clock_every_s

    def close(self, timeout_s: float) -> None:
        """Wait a little for the last answers, then count as lost what is still out."""
        if self._rate_hz and self._uplink.connected():
            with self._lock:
                self._lock.wait_for(lambda: not any(p.waiting for p in self._paths.values()), timeout_s)
        self._expire(float("inf"))

    def report(self) -> dict[str, PathReport]:
        """What was measured so far."""
        with self._lock:
            return {
                name: PathReport(
                    path.sent,
                    path.received,
                    path.lost,
                    percentile(path.rtts_ms, 50),
                    percentile(path.rtts_ms, 95),
                )
                for name, path in self._paths.items()
            }

    def _on_pong(self, message: Message) -> None:
        name = parse_topic(message.topic).name
        path = self._paths[name]
        try:
            pong = decode_pong(message.payload)
        except ContractError:
            return  # not ours: anybody with the right may publish there
        with self._lock:
            sent = path.waiting.pop(pong.id, None)
            if sent is None:
                return  # too late and counted as lost, or a second answer
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
    """The value that ``percent`` of the values are not above (nearest rank); None without values."""
    if not values:
        return None
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)
    return ordered[max(0, int(rank) - 1)]


def _ignore(_: UplinkError | None) -> None:
    """A ping that was not written shows as lost."""
