"""The live lane: of each stream the newest sample, at most so many a second, never a queue.

The first sample of a burst goes at once, from the thread that brought it. What comes before the next
one is due replaces what waits; it goes with the first sample that is due, or, if the stream falls
silent, half a period later. While a message is not written yet, or there is no connection, nothing
is sent at all, so that the first one afterwards is the newest.

The lane has what the record lane leaves of the connection's `Allowance`. Where that is too little, streams
that are due wait for their turn. Next is the one that went longest ago, with the newest sample that it has
then: so all go equally often, and a slow stream takes no more than its own rate. `tempo` says how often.

Messages go straight to the live rule, by Basic Ingest, which costs no messaging and which nothing else
sees. The first of a run, one with another fault code than the one before and one in ten seconds pass the
broker instead, for the rules that alert a human and whoever else listens there; the live rule hears those
as well, so each message comes to the dashboard once. Another fault code waits for no slow rate and for
nobody's turn: it goes as soon as the fastest rate would have let it.
"""

from __future__ import annotations

import functools
import heapq
import logging
import threading
from collections import deque
from typing import Callable, Mapping, NamedTuple

from iort_agent.clock import Clock
from iort_agent.errors import UplinkError
from iort_agent.mqtt.uplink import Uplink
from iort_agent.rate_limiter import LIVE, URGENT, Allowance
from iort_contract.catalog.vesc import FAULT_FIELD
from iort_contract.limits import (
    LIVE_BROKER_EVERY_S,
    LIVE_MAX_AGE_MS,
    LIVE_MAX_RATE_HZ,
    MAX_MESSAGE_BYTES,
    ContractError,
    Value,
)
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import LIVE as LIVE_LANE
from iort_contract.topics import build_topic, live_topic

_log = logging.getLogger(__name__)
_FASTEST_S = 1 / LIVE_MAX_RATE_HZ
# Rates are of so many of the last seconds. The lane is slowed down when streams lost their place in more
# than half of them, and no longer when in none.
_SECONDS = 5


class Tempo(NamedTuple):
    """How often a stream may go, and how often those go, on average, that the limit keeps waiting."""

    asked_hz: float
    effective_hz: float
    slowed: bool


class _Mark(NamedTuple):
    """A stream's counts, once a second."""

    at: float
    offers: int
    seq: int
    late: int


class _Slot:
    """What the lane knows of one stream. ``values`` are the newest sample's as long as it waits."""

    def __init__(self, topic: str, broker_topic: str, turn: int) -> None:
        self.topic = topic
        self.broker_topic = broker_topic
        self.broker_due = 0.0
        self.fault: Value = None
        self.t_us = 0
        self.values: Mapping[str, Value] | None = None
        self.offered = 0.0
        # When the next one may go: in its turn, and with another fault code.
        self.due = self.fault_due = 0.0
        # Which turn of the lane's it had last; since when it waits for the next one, and how often it waited
        # so long that it lost its place on the grid.
        self.turn = turn
        self.queued: float | None = None
        self.late = 0
        self.payload_bytes = 0
        self.seq = 0
        self.written = 0
        self.writing = False
        self.offers = 0
        self.marks: deque[_Mark] = deque(maxlen=_SECONDS + 1)
        self.hz = 0.0


class LiveLane:
    """Sends the newest samples. `offer` is called by sources, `tick` now and then; ``offset_us`` says by
    how much the cloud's clock is ahead of this one, if it is known."""

    def __init__(
        self,
        *,
        robot: str,
        namespace: str,
        boot: str,
        rate_hz: float,
        uplink: Uplink,
        clock: Clock,
        allowance: Allowance,
        offset_us: Callable[[], int | None],
    ) -> None:
        self._robot = robot
        self._namespace = namespace
        self._boot = boot
        self.enabled = True
        self._rate_hz, self._period_s = rate_hz, 1 / rate_hz
        self._uplink = uplink
        self._clock = clock
        self._allowance = allowance
        self._offset_us = offset_us
        self._lock = threading.Lock()
        self._slots: dict[str, _Slot] = {}
        # Streams that are due: a heap by their last turns, which no two streams share.
        self._line: list[tuple[int, _Slot]] = []
        self._turn = 0
        self._marked = clock.monotonic()
        self._slow_s: deque[bool] = deque(maxlen=_SECONDS)
        self._tempo = Tempo(rate_hz, rate_hz, slowed=False)
        self.refused = 0

    @property
    def published(self) -> int:
        """How many messages were written."""
        return sum(slot.written for slot in list(self._slots.values()))

    @property
    def tempo(self) -> Tempo:
        """What became of the rate in the last seconds."""
        return self._tempo

    def rates_hz(self) -> dict[str, float]:
        """Messages a second of each stream, of the last seconds."""
        return {name: round(slot.hz, 2) for name, slot in list(self._slots.items())}

    def set_rate(self, rate_hz: float) -> None:
        """Another rate, from now on."""
        with self._lock:
            self._rate_hz, self._period_s = rate_hz, 1 / rate_hz
            now = self._clock.monotonic()
            for slot in self._slots.values():
                # What was due late at a slow rate is due soon at a fast one.
                slot.due = min(slot.due, now + self._period_s)
            self._tempo = Tempo(rate_hz, min(rate_hz, self._tempo.effective_hz), self._tempo.slowed)

    def offer(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """The newest sample of a stream; replaces the one before it."""
        if not self.enabled:
            return
        now = self._clock.monotonic()
        with self._lock:
            slot = self._slots.get(stream)
            if slot is None:
                slot = self._slots[stream] = _Slot(
                    live_topic(self._robot, stream, self._namespace),
                    build_topic(LIVE_LANE, self._robot, stream, self._namespace),
                    turn=self._turn,
                )
                self._turn += 1
            slot.t_us, slot.values, slot.offered = t_us, values, now
            slot.offers += 1
            if now >= slot.due or self._is_new_fault(slot, values, now):
                self._take_turn(slot, values, now)
            self._serve(now)

    def tick(self) -> None:
        """Send what a stream left behind when it fell silent or the connection was down."""
        now = self._clock.monotonic()
        with self._lock:
            for slot in self._slots.values():
                values = slot.values
                if values is None:
                    continue
                if now - slot.offered > LIVE_MAX_AGE_MS / 1000:
                    slot.values = None
                elif now >= slot.due + self._period_s / 2 or self._is_new_fault(slot, values, now):
                    self._take_turn(slot, values, now)
            self._serve(now)
            if now - self._marked >= 1:
                self._marked = now
                self._measure(now)

    @staticmethod
    def _is_new_fault(slot: _Slot, values: Mapping[str, Value], now: float) -> bool:
        return now >= slot.fault_due and _fault(values) != slot.fault

    def _take_turn(self, slot: _Slot, values: Mapping[str, Value], now: float) -> None:
        """Send what must not wait; otherwise let the stream wait for its turn, unless it does already."""
        if (
            self._is_new_fault(slot, values, now)
            and slot.seq
            and self._allowance.may_go(URGENT, slot.broker_topic, slot.payload_bytes)
        ):
            self._send(slot, values, now)
        elif now >= slot.due and slot.queued is None:
            slot.queued = now
            heapq.heappush(self._line, (slot.turn, slot))

    def _serve(self, now: float) -> None:
        """Send of the streams that wait as many as there is room for."""
        line = self._line
        while line:
            _, slot = line[0]
            values, queued = slot.values, slot.queued
            # After a fault that did not wait, the stream is no longer due.
            ready = values is not None and now >= slot.due and not slot.writing and self._uplink.connected()
            if ready and not self._allowance.may_go(LIVE, slot.topic, slot.payload_bytes):
                return
            heapq.heappop(line)
            slot.queued = None
            if ready and values is not None and queued is not None:
                slot.late += now - queued > self._period_s / 2
                self._send(slot, values, now)

    def _measure(self, now: float) -> None:
        """Once a second: how often each stream went, and whether the limit kept any of them waiting."""
        slow_hz, late = [], False
        if not self._uplink.connected():
            for slot in self._slots.values():
                slot.marks.clear()
            return
        for slot in self._slots.values():
            waits = slot.queued is not None and now - slot.queued > max(self._period_s / 2, 1.0)
            slot.late += waits
            mark = _Mark(now, slot.offers, slot.seq, slot.late)
            before = slot.marks[-1] if slot.marks else mark
            slot.marks.append(mark)
            first = slot.marks[0]
            if now > first.at:
                slot.hz = (mark.seq - first.seq) / (now - first.at)
            # A stream that brings no more than it is sent loses nothing by waiting.
            if mark.late > first.late and mark.offers - first.offers > mark.seq - first.seq + 1:
                slow_hz.append(slot.hz)
                late = late or mark.late > before.late
        self._slow_s.append(late)
        was, asked_hz = self._tempo.slowed, self._rate_hz
        slowed = any(self._slow_s) if was else sum(self._slow_s) > _SECONDS / 2
        effective_hz = min(asked_hz, sum(slow_hz) / len(slow_hz)) if slowed and slow_hz else asked_hz
        self._tempo = Tempo(asked_hz, round(effective_hz, 2), slowed)
        if slowed and not was:
            _log.warning(
                "live: slowed down to %.2g Hz a stream, %g Hz are asked for: the connection may send "
                "100 messages and 512 KB a second, and recordings go first", effective_hz, asked_hz,
            )  # fmt: skip
        elif was and not slowed:
            _log.info("live: up to %g Hz a stream again", asked_hz)

    def _send(self, slot: _Slot, values: Mapping[str, Value], now: float) -> None:
        if slot.writing or not self._uplink.connected():
            return
        slot.values = None
        sample = LiveSample(
            boot=self._boot,
            seq=slot.seq,
            t_us=slot.t_us,
            sent_us=self._clock.now_us(),
            sample=values,
            offset_us=self._offset_us(),
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
            # On a grid, so that a sample a little late does not slow the rate down, but never twice as fast.
            slot.due = max(slot.due, now - self._period_s / 2) + self._period_s
        else:
            slot.due = max(slot.due, now + _FASTEST_S)
        slot.fault_due = now + _FASTEST_S
        slot.writing = True
        topic = _topic(slot, _fault(values), now)
        slot.payload_bytes = len(payload)
        self._allowance.spend(topic, payload)
        self._uplink.publish(topic, payload, qos=0, done=functools.partial(self._done, slot))

    @staticmethod
    def _done(slot: _Slot, error: UplinkError | None) -> None:
        # In the network's own thread, or within `_send`: so without the lock. Of a stream one message is
        # on its way at a time, and no other before the last line.
        if error is None:
            slot.written += 1
        else:
            # It may have been one for the broker, and have said another fault code.
            slot.broker_due, slot.fault = 0.0, None
        slot.writing = False


def _fault(values: Mapping[str, Value]) -> Value:
    """The fault code; None for NaN, which is another than itself each time."""
    code = values.get(FAULT_FIELD)
    return code if code == code else None  # noqa: PLR0124 - what NaN is not


def _topic(slot: _Slot, fault: Value, now: float) -> str:
    """Which way the next message of a stream goes."""
    if now < slot.broker_due and fault == slot.fault:
        return slot.topic
    slot.broker_due, slot.fault = now + LIVE_BROKER_EVERY_S, fault
    return slot.broker_topic


def _encode(sample: LiveSample) -> bytes:
    payload = encode_live(sample)
    if len(payload) > MAX_MESSAGE_BYTES:
        raise ContractError(f"the message would have {len(payload)} of {MAX_MESSAGE_BYTES} bytes")
    return payload
