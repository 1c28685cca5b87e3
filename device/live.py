"""The live lane: of each stream the newest sample, at most so many a second, never a queue.

The first sample of a burst goes at once, from the thread that brought it. What comes before the next
one is due replaces what waits; it goes with the first sample that is due, or, if the stream falls
silent, half a period later. While a message is not written yet, or there is no connection, nothing
is sent at all, so that the first one afterwards is the newest.

Messages go straight to the live rule, by Basic Ingest, which costs no messaging and which nothing else
sees. The first of a run, one with another fault code than the one before and one in ten seconds pass the
broker instead, for the rules that alert a human and whoever else listens there; the live rule hears those
as well, so each message comes to the dashboard once. Another fault code waits for no slow rate: it goes
as soon as the fastest rate would have let it.
"""

from __future__ import annotations

import functools
import logging
import threading
from typing import Callable, Mapping

import contract
from contract import ContractError, LiveSample, Value
from device.allowance import Allowance
from device.clock import Clock
from device.errors import UplinkError
from device.uplink import Uplink

_log = logging.getLogger(__name__)
_FASTEST_S = 1 / contract.LIVE_MAX_RATE_HZ


class _Slot:
    """What the lane knows of one stream. ``values`` are the newest sample's as long as it waits."""

    def __init__(self, topic: str, broker_topic: str) -> None:
        self.topic = topic
        self.broker_topic = broker_topic
        self.broker_due = 0.0
        self.fault: Value = None
        self.t_us = 0
        self.values: Mapping[str, Value] | None = None
        self.offered = 0.0
        # When the next one may go: in its turn, and with another fault code.
        self.due = self.fault_due = 0.0
        self.seq = 0
        self.written = 0
        self.writing = False


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
        self._period_s = 1 / rate_hz
        self._uplink = uplink
        self._clock = clock
        self._allowance = allowance
        self._offset_us = offset_us
        self._lock = threading.Lock()
        self._slots: dict[str, _Slot] = {}
        self.refused = 0

    @property
    def published(self) -> int:
        """How many messages were written."""
        return sum(slot.written for slot in list(self._slots.values()))

    def set_rate(self, rate_hz: float) -> None:
        """Another rate, from now on."""
        with self._lock:
            self._period_s = 1 / rate_hz
            now = self._clock.monotonic()
            for slot in self._slots.values():
                # What was due late at a slow rate is due soon at a fast one.
                slot.due = min(slot.due, now + self._period_s)

    def offer(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """The newest sample of a stream; replaces the one before it."""
        if not self.enabled:
            return
        now = self._clock.monotonic()
        with self._lock:
            slot = self._slots.get(stream)
            if slot is None:
                slot = self._slots[stream] = _Slot(
                    contract.live_topic(self._robot, stream, self._namespace),
                    contract.build_topic(contract.LIVE, self._robot, stream, self._namespace),
                )
            slot.t_us, slot.values, slot.offered = t_us, values, now
            if now >= slot.due or (now >= slot.fault_due and _fault(values) != slot.fault):
                self._send(slot, values, now)

    def tick(self) -> None:
        """Send what a stream left behind when it fell silent or the connection was down."""
        now = self._clock.monotonic()
        with self._lock:
            for slot in self._slots.values():
                values = slot.values
                if values is None:
                    continue
                if now - slot.offered > contract.LIVE_MAX_AGE_MS / 1000:
                    slot.values = None
                elif now >= slot.due + self._period_s / 2 or (
                    now >= slot.fault_due and _fault(values) != slot.fault
                ):
                    self._send(slot, values, now)

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
        if now >= slot.due:
            # On a grid, so that a sample a little late does not slow the rate down, but never twice as fast.
            slot.due = max(slot.due, now - self._period_s / 2) + self._period_s
        else:
            slot.due = max(slot.due, now + _FASTEST_S)
        slot.fault_due = now + _FASTEST_S
        slot.writing = True
        topic = _topic(slot, _fault(values), now)
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
    code = values.get(contract.FAULT_FIELD)
    return code if code == code else None  # noqa: PLR0124 - what NaN is not


def _topic(slot: _Slot, fault: Value, now: float) -> str:
    """Which way the next message of a stream goes."""
    if now < slot.broker_due and fault == slot.fault:
        return slot.topic
    slot.broker_due, slot.fault = now + contract.LIVE_BROKER_EVERY_S, fault
    return slot.broker_topic


def _encode(sample: LiveSample) -> bytes:
    payload = contract.encode_live(sample)
    if len(payload) > contract.MAX_MESSAGE_BYTES:
        raise ContractError(f"the message would have {len(payload)} of {contract.MAX_MESSAGE_BYTES} bytes")
    return payload
