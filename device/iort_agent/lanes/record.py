"""The record lane: every batch, in order, at QoS 1, until the broker has it.

Batches are published from the spool, up to ``window`` unacknowledged ones at a time, and leave the
spool with their PUBACK only. After a failure nothing more is sent until every publish on its way has
succeeded or failed; then what is left in the spool is sent again from the oldest on. After a lost
connection the same, once it is back. A batch may therefore arrive twice, which downstream does no
harm: it has the same key and the same content.

It goes first on its connection: it tells the `RateLimiter` what it needs, and the others share the rest.
"""

from __future__ import annotations

import functools
import logging
import math
import random
import threading
from collections import deque
from typing import NamedTuple, Sequence

from iort_agent.common.threads import Clock
from iort_agent.errors import UplinkError
from iort_agent.lanes import RecordConfig
from iort_agent.mqtt.rate_limiter import PUBLISHES_PER_S, SHARE, RateLimiter
from iort_agent.mqtt.uplink import Uplink
from iort_agent.sources import SourceConfig
from iort_agent.spool import Entry, Spool
from iort_contract.topics import record_topic

# Batches close together at the second's edge, so the mean of fewer seconds would go up and down.
_WINDOW_S = 10.0
_EVERY_S = 1.0
# A smaller backlog, in seconds of production or in batches, is normal at a second's edge.
_BACKLOG_S, _FEW = 2.0, 10


class Rate(NamedTuple):
    """Batches and payload bytes, a second or in all."""

    batches: float
    payload_bytes: float


class _Mark(NamedTuple):
    at: float
    # In all: put into the spool, and acknowledged.
    made: Rate
    sent: Rate
    # The smallest backlog since the mark before.
    least: float


class Production:
    """The rates of the last ten seconds. `note` is called several times a second."""

    def __init__(self) -> None:
        self._marks: deque[_Mark] = deque()
        self._least = float("inf")
        self._connected_since: float | None = None
        self.made = self.sent = Rate(0.0, 0.0)
        # Whether the backlog grows although there is a connection.
        self.behind = False

    def note(self, now: float, *, made: Rate, sent: Rate, backlog: float, connected: bool) -> None:
        """Note what was made and sent in all, and how many batches wait now."""
        if not connected:
            self._connected_since = None
        elif self._connected_since is None:
            self._connected_since = now
        self._least = min(self._least, backlog)
        marks = self._marks
        if marks and now - marks[-1].at < _EVERY_S:
            return
        marks.append(_Mark(now, made, sent, self._least))
        self._least = backlog
        if len(marks) == 1:
            return
        while len(marks) > 2 and now - marks[1].at >= _WINDOW_S:
            marks.popleft()
        self.made, self.sent = _per_s(marks, made, marks[0].made), _per_s(marks, sent, marks[0].sent)
        self._judge(now, backlog)

    def _judge(self, now: float, backlog: float) -> None:
        marks, since = list(self._marks), self._connected_since
        if since is None or now - since < _WINDOW_S or backlog <= max(_FEW, self.made.batches * _BACKLOG_S):
            self.behind = False
            return
        # Compare the smallest backlog of each half: batches that have just closed together are no growth.
        half = len(marks) // 2
        before, after = min(m.least for m in marks[:half]), min(m.least for m in marks[half:])
        if after != before:
            self.behind = after > before


def _per_s(marks: deque[_Mark], now: Rate, then: Rate) -> Rate:
    seconds = marks[-1].at - marks[0].at
    return Rate(
        max(0.0, now.batches - then.batches) / seconds,
        max(0.0, now.payload_bytes - then.payload_bytes) / seconds,
    )


_log = logging.getLogger(__name__)

# As many a round trip can be sent: with 0.5 s of it, 100 a second. AWS allows 100.
WINDOW = 50
# What to do where more is recorded than one connection may send.
TODO = (
    "record fewer topics or fields, let topics of one type share a stream, or give some of them to a second "
    "agent with a robot name of its own"
)
_MIN_RETRY_S, _MAX_RETRY_S = 0.5, 30.0
# Enough for the longest pause. A power of any number of failures would be too large for a float.
_MAX_DOUBLINGS = 6


def too_many(sources: Sequence[SourceConfig], record: RecordConfig) -> str | None:
    """Why the streams of the sources are too many for one connection, in a line; None where they are not.

    It is about streams that bring samples all the time; where every sample goes by itself (``batch_s`` 0),
    nobody knows how many that are.
    """
    if not record.enabled:
        return None
    batch_s, most = record.batch_s, PUBLISHES_PER_S * SHARE
    streams = sum(len(source.streams()) for source in sources)
    # A batch lies within a second.
    made = streams * math.ceil(1 / batch_s) if batch_s else streams
    if made <= most:
        return None
    return f"{streams} streams are up to {made} batches a second, and one connection takes {most:.0f}"


class RecordLane:
    """Empties the spool into the uplink."""

    def __init__(
        self,
        *,
        robot: str,
        namespace: str,
        spool: Spool,
        uplink: Uplink,
        clock: Clock,
        rate_limiter: RateLimiter,
        window: int = WINDOW,
        chance: random.Random | None = None,
    ) -> None:
        self._robot = robot
        self._namespace = namespace
        self._spool = spool
        self._uplink = uplink
        self._clock = clock
        self._rate_limiter = rate_limiter
        self._window = window
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self._wake = threading.Event()
        self._changed = threading.Condition()
        # Under _changed: what is on its way, the last entry sent, and since when a failure holds it up.
        # A new epoch begins with each rewind, so that late news of the one before are told apart.
        self._in_flight: set[int] = set()
        self._sent_id = 0
        self._epoch = 0
        self._failures = 0
        self._refusal = ""
        self._failed = False
        self._hold_until = 0.0
        self._acked = Rate(0, 0)
        self._production = Production()
        # What the operator should know and do, in a line; None while all that is recorded gets away.
        self.alarm: str | None = None
        uplink.on_connection(self._on_connection)
        spool.on_stored(self.wake)

    def wake(self) -> None:
        """Look at the spool again: something was put."""
        self._wake.set()

    def run(self, stop: threading.Event) -> None:
        """Publish until ``stop`` is set; call `wake` after setting it. It may run again after an error."""
        with self._changed:
            self._rewind()
        while not stop.is_set():
            self._wake.clear()
            self._clock.wait(self._wake, self.step())

    def step(self) -> float | None:
        """Publish what may be published now; seconds until there may be more, None for: on `wake`."""
        while self._uplink.connected():
            with self._changed:
                if self._failed and not self._in_flight:
                    self._rewind()
                if self._failed or len(self._in_flight) >= self._window:
                    return None
                hold_s = self._hold_until - self._clock.monotonic()
                if hold_s > 0:
                    return hold_s
                entry = self._spool.next(self._sent_id)
                if entry is None:
                    return None
                topic = record_topic(self._robot, entry.stream, self._namespace)
                delay_s = self._rate_limiter.record(topic, entry.payload)
                if delay_s > 0:
                    return delay_s
                self._in_flight.add(entry.id)
                self._sent_id = entry.id
                done = functools.partial(self._done, self._epoch, entry)
            self._uplink.publish(topic, entry.payload, qos=1, done=done)
        return None

    def tick(self) -> None:
        """Learn how much is recorded, tell the rate_limiter, and see whether all of it gets away."""
        with self._changed:
            acked, left = self._acked, self._spool.backlog()
        made = Rate(
            left.batches + acked.batches + self._spool.dropped().batches,
            left.payload_bytes + acked.payload_bytes,
        )
        production, (publishes, payloads) = self._production, self._rate_limiter.rates
        production.note(
            self._clock.monotonic(),
            made=made,
            sent=acked,
            backlog=left.batches,
            connected=self._uplink.connected(),
        )
        self._rate_limiter.expect(
            production.made, backlog=left.batches > publishes or left.payload_bytes > payloads
        )
        was, self.alarm = self.alarm, self._alarm(left.batches) if production.behind else None
        if self.alarm and not was:
            _log.warning("record: %s", self.alarm)
        elif was and not self.alarm and self._uplink.connected():
            _log.info("record: the queue no longer grows")

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until everything in the spool is acknowledged; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._spool.backlog().batches == 0, timeout_s)

    def _done(self, epoch: int, entry: Entry, error: UplinkError | None) -> None:
        with self._changed:
            if error is None:
                # Whenever it comes, an acknowledgement means that the broker has the batch.
                self._spool.ack(entry.id)
                acked = self._acked
                self._acked = Rate(acked.batches + 1, acked.payload_bytes + len(entry.payload))
                self._changed.notify_all()
            was_full = len(self._in_flight) >= self._window
            if epoch == self._epoch:
                self._in_flight.discard(entry.id)
                if error is None:
                    self._failures = 0 if not self._failed else self._failures
                elif not self._failed:
                    self._failed = True
                    # A lost connection is told of elsewhere, and not a reason to wait.
                    if self._uplink.connected():
                        self._hold(entry, error)
            waits = self._failed or was_full
        # Otherwise the lane waits for the spool, which wakes it.
        if waits:
            self._wake.set()

    def _hold(self, entry: Entry, error: UplinkError) -> None:
        """Wait longer after each failure in a row, with full jitter above a floor."""
        ceiling = min(_MAX_RETRY_S, _MIN_RETRY_S * 2 ** min(self._failures, _MAX_DOUBLINGS))
        self._failures += 1
        self._refusal = str(error)
        delay = _MIN_RETRY_S + self._chance.random() * (ceiling - _MIN_RETRY_S)
        self._hold_until = self._clock.monotonic() + delay
        _log.warning(
            "record: batch %d of %s was not accepted, sending again in %.1f s: %s",
            entry.seq, entry.stream, delay, error,
        )  # fmt: skip

    def _alarm(self, left: int) -> str:
        made, sent, limit = self._production.made, self._production.sent, Rate(*self._rate_limiter.rates)
        if self._failures:
            todo = self._refusal
        elif made.batches > limit.batches or made.payload_bytes > limit.payload_bytes:
            todo = f"the limit allows {_text(limit)}: {TODO}"
        else:
            todo = f"the limit would allow {_text(limit)}: the network is too slow or loses messages"
        return (
            f"more is recorded than is sent: {left} batches wait, {_text(made)} are made, "
            f"{_text(sent)} were sent; {todo}"
        )

    def _rewind(self) -> None:
        self._epoch += 1
        self._in_flight.clear()
        self._sent_id = 0
        self._failed = False

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - the uplink's signature
        with self._changed:
            if not connected:
                # What was on its way failed with the connection, not by itself.
                self._rewind()
                self._failures = 0
                self._hold_until = 0.0
        self._wake.set()


def _text(rate: Rate) -> str:
    return f"{rate.batches:.0f} batches/s ({rate.payload_bytes / 1024:.0f} KB/s)"
