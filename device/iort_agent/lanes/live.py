"""The live lane: the newest sample of each stream, at most so many a second, never a queue.

The first sample of a burst is sent at once, in the thread that brought it. A later one replaces the sample
that waits. It is sent with the first sample that is due, or half a period later, a second at most, if the
stream falls silent. While a message is being written, or without a connection, nothing is sent, so that the
next one is the newest.

The lane uses what the record lane leaves of the connection's `RateLimiter`. If that is too little, due
streams wait in line, the one that was sent longest ago first. So all are sent equally often, and a slow
stream takes no more than its own rate. `tempo` says how often.

Messages go to the live rule by Basic Ingest, which costs no messaging and which nobody else receives. The
first message of a run, one with another fault code, and one every ten seconds go to the broker instead, for
the rules that alert a human and for other subscribers. The live rule receives those, too, so the dashboard
shows each message once. Another fault code waits for no slow rate and no line: it is sent at the fastest
rate. So is every sample of an urgent stream, which a driver waits for.

Every message says when the stream's next one comes. So a change of the rate is told at once.
"""

from __future__ import annotations

import functools
import heapq
import logging
import math
import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Callable, Iterable, Mapping, NamedTuple

from iort_agent.errors import UplinkError
from iort_agent.mqtt.rate_limiter import LIVE, URGENT
from iort_agent.mqtt.uplink import Link
from iort_contract import topics
from iort_contract.catalog.vesc import FAULT_FIELD
from iort_contract.limits import (
    LIVE_BROKER_EVERY_S,
    LIVE_MAX_AGE_MS,
    LIVE_MAX_RATE_HZ,
    MAX_MESSAGE_BYTES,
    MAX_NEXT_MS,
    ContractError,
    Value,
)
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.ros.message import RosMessage
from iort_contract.topics import live_topic

_log = logging.getLogger(__name__)

# Rates are means of so many seconds. The lane counts as slowed once streams were late in more than half of
# them, until they were late in none.
_SECONDS = 5


def fault_of(values: Mapping[str, Value]) -> Value:
    """The fault code; None for NaN, which never equals itself."""
    code = values.get(FAULT_FIELD)
    return code if code == code else None  # noqa: PLR0124 - False for NaN alone


class Demand(NamedTuple):
    """What the lane shall send: the most messages a second of a stream, and whether all go to the broker."""

    rate_hz: float
    to_broker: bool = False


class Tempo(NamedTuple):
    """The configured rate of a stream, and the mean rate of the streams that the rate limiter keeps
    waiting."""

    asked_hz: float
    effective_hz: float
    slowed: bool


class _Mark(NamedTuple):
    """A stream's counts at one second."""

    at: float
    offers: int
    seq: int
    late: int


@dataclass
class Slot:
    """The state of one stream. ``values`` are the newest sample's while it waits."""

    topic: str
    broker_topic: str
    # The number of its last turn, since when it waits in line, and how often it waited too long.
    turn: int
    queued: float | None = None
    late: int = 0
    # When the next message may go: in its turn, with another fault code, and over the broker.
    due: float = 0.0
    fault_due: float = 0.0
    broker_due: float = 0.0
    fault: Value = None
    t_us: int = 0
    values: Mapping[str, Value] | None = None
    # The newest sample, sent or not.
    newest: Mapping[str, Value] | None = None
    offered: float = 0.0
    # Whether each sample waits for no slow rate, and goes to the broker.
    urgent: bool = False
    offers: int = 0
    seq: int = 0
    payload_bytes: int = 0
    writing: bool = False
    written: int = 0
    hz: float = 0.0
    marks: deque[_Mark] = field(default_factory=lambda: deque(maxlen=_SECONDS + 1))

    def is_urgent(self, now: float) -> bool:
        """Whether the waiting sample may go at once: it is urgent, or has another fault code."""
        if self.values is None or now < self.fault_due:
            return False
        return self.urgent or fault_of(self.values) != self.fault


class TempoMeter:
    """Measures the rate of each stream, and whether the rate limiter slows the lane down."""

    def __init__(self, rate_hz: float) -> None:
        self._slow_s: deque[bool] = deque(maxlen=_SECONDS)
        self.tempo = Tempo(rate_hz, rate_hz, slowed=False)

    def set_rate(self, rate_hz: float) -> None:
        """Take another configured rate."""
        slowed = self.tempo.slowed
        effective_hz = min(rate_hz, self.tempo.effective_hz) if slowed else rate_hz
        self.tempo = Tempo(rate_hz, effective_hz, slowed)

    def measure(self, slots: Iterable[Slot], now: float, *, connected: bool) -> None:
        """Update the rates; called once a second."""
        if not connected:
            for slot in slots:
                slot.marks.clear()
            return
        asked_hz, was = self.tempo.asked_hz, self.tempo.slowed
        slow_hz, late = [], False
        for slot in slots:
            slot.late += slot.queued is not None and now - slot.queued > max(0.5 / asked_hz, 1.0)
            mark = _Mark(now, slot.offers, slot.seq, slot.late)
            before = slot.marks[-1] if slot.marks else mark
            slot.marks.append(mark)
            first = slot.marks[0]
            if now > first.at:
                slot.hz = (mark.seq - first.seq) / (now - first.at)
            # A stream whose samples are all sent loses nothing by waiting.
            if mark.late > first.late and mark.offers - first.offers > mark.seq - first.seq + 1:
                slow_hz.append(slot.hz)
                late = late or mark.late > before.late
        self._slow_s.append(late)
        slowed = any(self._slow_s) if was else sum(self._slow_s) > _SECONDS / 2
        effective_hz = min(asked_hz, sum(slow_hz) / len(slow_hz)) if slowed and slow_hz else asked_hz
        self.tempo = Tempo(asked_hz, round(effective_hz, 2), slowed)
        if slowed and not was:
            _log.warning(
                "live: slowed down to %.2g Hz a stream, %g Hz are configured: the connection may send "
                "100 messages and 512 KB a second, and recordings go first", effective_hz, asked_hz,
            )  # fmt: skip
        elif was and not slowed:
            _log.info("live: up to %g Hz a stream again", asked_hz)


_FASTEST_S = 1 / LIVE_MAX_RATE_HZ
# While nobody looks, so many seconds of messages are taken together: a batch closes after one.
_TOGETHER_S = 0.3
_PRESENT_S = LIVE_MAX_AGE_MS / 1000


class LiveLane:
    """Sends the newest samples. Sources call `offer`, the ticker calls `tick`. ``offset_us`` gives the
    cloud's clock minus this one, if it is known."""

    def __init__(self, link: Link, *, boot: str, rate_hz: float, offset_us: Callable[[], int | None]) -> None:
        self._link, self._uplink, self._rate_limiter = link, link.uplink, link.rate_limiter
        self._clock = link.clock
        self._boot = boot
        self.enabled = True
        self._period_s = 1 / rate_hz
        self._to_broker = False
        self._offset_us = offset_us
        self._lock = threading.Lock()
        self._slots: dict[str, Slot] = {}
        # The due streams: a heap by their last turns, which are unique.
        self._line: list[tuple[int, Slot]] = []
        self._turn = 0
        self._marked = self._clock.monotonic()
        self._meter = TempoMeter(rate_hz)
        self.refused = 0

    @property
    def _patience_s(self) -> float:
        """How late a message may be: half a period, and never so late that its sample is old."""
        return min(self._period_s, _PRESENT_S) / 2

    @property
    def tempo(self) -> Tempo:
        return self._meter.tempo

    @property
    def published(self) -> int:
        """How many messages were written."""
        return sum(slot.written for slot in list(self._slots.values()))

    def rates_hz(self) -> dict[str, float]:
        """Messages a second of each stream, in the last seconds."""
        return {name: round(slot.hz, 2) for name, slot in list(self._slots.items())}

    def follow(self, demand: Demand, *, at_once: bool = False) -> None:
        """Send as is asked from now on; with ``at_once``, the newest sample of each stream now."""
        with self._lock:
            now, was_s, self._period_s = self._clock.monotonic(), self._period_s, 1 / demand.rate_hz
            self._to_broker = demand.to_broker
            for slot in self._slots.values() if self.enabled else ():
                # A message due late at a slow rate is due soon at a fast one. The next one tells viewers of a
                # slow rate before they take the stream for silent.
                soon = at_once or self._period_s > was_s
                slot.due = min(slot.due, now + (0.0 if soon else self._period_s))
                if at_once:
                    self._show_again(slot, now)
            self._serve(now)
            self._meter.set_rate(demand.rate_hz)

    def offer(
        self,
        stream: str,
        t_us: int,
        values: Mapping[str, Value],
        *,
        urgent: bool = False,
        more: bool = False,
    ) -> float:
        """Take the newest sample of a stream; it replaces the one that waits. ``more`` and the result are
        `iort_agent.sources.Emit`'s."""
        now = self._clock.monotonic()
        if not self.enabled:
            return now + _FASTEST_S
        with self._lock:
            slot = self._slots.get(stream)
            if slot is None:
                basic_ingest = live_topic(self._link.robot, stream, self._link.namespace)
                broker_topic = self._link.topic(topics.LIVE, stream)
                slot = self._slots[stream] = Slot(basic_ingest, broker_topic, turn=self._turn)
                self._turn += 1
            slot.urgent = urgent
            slot.t_us, slot.values, slot.newest, slot.offered = t_us, values, values, now
            slot.offers += 1
            if slot.is_urgent(now) or (now >= slot.due and not more):
                self._take_turn(slot, now)
            self._serve(now)
            # Another fault code may come at any time, and does not wait for a slow rate.
            faulty = not isinstance(values, RosMessage) or values.kind.has(FAULT_FIELD)
            return min(slot.due, now + (_FASTEST_S if faulty else _TOGETHER_S))

    def tick(self) -> None:
        """Send what waits since a stream fell silent or the connection was lost."""
        now = self._clock.monotonic()
        with self._lock:
            for slot in self._slots.values():
                if slot.values is None:
                    continue
                if now - slot.offered > _PRESENT_S:
                    slot.values = None
                elif now >= slot.due + self._patience_s or slot.is_urgent(now):
                    self._take_turn(slot, now)
            self._serve(now)
            if now - self._marked >= 1:
                self._marked = now
                self._meter.measure(self._slots.values(), now, connected=self._uplink.connected())

    def _show_again(self, slot: Slot, now: float) -> None:
        """Let the newest sample take its turn, even if it was sent before: who looks now did not see it."""
        if slot.newest is not None and now - slot.offered <= _PRESENT_S:
            slot.values = slot.newest
            self._take_turn(slot, now)

    def _take_turn(self, slot: Slot, now: float) -> None:
        """Send an urgent sample and another fault code at once; put any other sample in line."""
        if (
            slot.is_urgent(now)
            and slot.seq
            and self._rate_limiter.may_go(URGENT, slot.broker_topic, slot.payload_bytes)
        ):
            self._send(slot, now)
        elif now >= slot.due and slot.queued is None:
            slot.queued = now
            heapq.heappush(self._line, (slot.turn, slot))

    def _serve(self, now: float) -> None:
        """Send from the line as much as the rate limiter allows."""
        while self._line:
            slot = self._line[0][1]
            # A stream that has just sent an urgent sample is no longer due.
            ready = (
                slot.values is not None and now >= slot.due and not slot.writing and self._uplink.connected()
            )
            if ready and not self._rate_limiter.may_go(LIVE, slot.topic, slot.payload_bytes):
                return
            heapq.heappop(self._line)
            queued, slot.queued = slot.queued, None
            if ready and queued is not None:
                slot.late += now - queued > self._period_s / 2
                self._send(slot, now)

    def _send(self, slot: Slot, now: float) -> None:
        values = slot.values
        if values is None or slot.writing or not self._uplink.connected():
            return
        slot.values = None
        sample = LiveSample(
            boot=self._boot,
            seq=slot.seq,
            t_us=slot.t_us,
            sent_us=self._clock.now_us(),
            sample=values,
            offset_us=self._offset_us(),
            next_ms=self._next_ms(),
        )
        try:
            payload = _encode(sample)
        except ContractError as error:
            level = logging.DEBUG if self.refused else logging.WARNING
            _log.log(level, "live: a sample cannot be sent on %s: %s", slot.broker_topic, error)
            self.refused += 1
            return
        slot.seq += 1
        slot.turn, self._turn = self._turn, self._turn + 1
        if now >= slot.due:
            # On a grid: a late sample does not lower the rate, and never doubles it.
            slot.due = max(slot.due, now - self._patience_s) + self._period_s
        else:
            slot.due = max(slot.due, now + _FASTEST_S)
        # On a grid, too.
        slot.fault_due = max(slot.fault_due, now - _FASTEST_S / 2) + _FASTEST_S
        slot.writing = True
        slot.payload_bytes = len(payload)
        topic = slot.broker_topic if self._to_broker or slot.urgent else slot.topic
        if now >= slot.broker_due or fault_of(values) != slot.fault:
            slot.broker_due, slot.fault = now + LIVE_BROKER_EVERY_S, fault_of(values)
            topic = slot.broker_topic
        self._link.publish(topic, payload, qos=0, done=functools.partial(_written, slot))

    def _next_ms(self) -> int:
        """The time from a message of a stream to its next one."""
        _, effective_hz, slowed = self._meter.tempo
        slowed_s = 1 / effective_hz if slowed and effective_hz else 0.0
        return min(MAX_NEXT_MS, math.ceil(max(self._period_s, slowed_s) * 1000))


def _written(slot: Slot, error: UplinkError | None) -> None:
    # Called in the network's own thread or within `_send`, so without the lock. One message of a stream is
    # being written at a time; the last line allows the next.
    if error is None:
        slot.written += 1
    else:
        # The lost message may have been for the broker, with another fault code.
        slot.broker_due, slot.fault = 0.0, None
    slot.writing = False


def _encode(sample: LiveSample) -> bytes:
    payload = encode_live(sample)
    if len(payload) > MAX_MESSAGE_BYTES:
        raise ContractError(f"the message must have at most {MAX_MESSAGE_BYTES} bytes, got {len(payload)}")
    return payload
