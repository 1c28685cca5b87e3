"""The state of the live lane's streams, and how often each is sent."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, field
from typing import Iterable, Mapping, NamedTuple

from iort_contract.catalog.vesc import FAULT_FIELD
from iort_contract.limits import Value

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
