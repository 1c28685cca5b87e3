"""The record lane: every batch, in order, at QoS 1, until the broker has it.

Batches are published from the spool, up to ``window`` unacknowledged ones at a time, and leave the
spool with their PUBACK only. After a failure nothing more is sent until every publish on its way has
succeeded or failed; then what is left in the spool is sent again from the oldest on. After a lost
connection the same, once it is back. A batch may therefore arrive twice, which downstream does no
harm: it has the same key and the same content.
"""

from __future__ import annotations

import functools
import logging
import random
import threading

import contract
from device.allowance import Allowance
from device.clock import Clock
from device.errors import UplinkError
from device.spool import Entry, Spool
from device.uplink import Uplink

_log = logging.getLogger(__name__)

WINDOW = 20
_MIN_RETRY_S, _MAX_RETRY_S = 0.5, 30.0


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
        allowance: Allowance,
        window: int = WINDOW,
        chance: random.Random | None = None,
    ) -> None:
        self._robot = robot
        self._namespace = namespace
        self._spool = spool
        self._uplink = uplink
        self._clock = clock
        self._allowance = allowance
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
        self._failed = False
        self._hold_until = 0.0
        uplink.on_connection(self._on_connection)
        spool.on_stored(self.wake)

    def wake(self) -> None:
        """Look at the spool again: something was put."""
        self._wake.set()

    def run(self, stop: threading.Event) -> None:
        """Publish until ``stop`` is set; call `wake` after setting it."""
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
                delay_s = self._allowance.delay_s()
                if delay_s > 0:
                    return delay_s
                self._in_flight.add(entry.id)
                self._sent_id = entry.id
                done = functools.partial(self._done, self._epoch, entry)
            topic = contract.record_topic(self._robot, entry.stream, self._namespace)
            self._allowance.spend(topic, entry.payload)
            self._uplink.publish(topic, entry.payload, qos=1, done=done)
        return None

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until everything in the spool is acknowledged; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self._spool.backlog().batches == 0, timeout_s)

    def _done(self, epoch: int, entry: Entry, error: UplinkError | None) -> None:
        with self._changed:
            if error is None:
                # Whenever it comes, an acknowledgement means that the broker has the batch.
                self._spool.ack(entry.id)
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
        ceiling = min(_MAX_RETRY_S, _MIN_RETRY_S * 2**self._failures)
        self._failures += 1
        delay = _MIN_RETRY_S + self._chance.random() * (ceiling - _MIN_RETRY_S)
        self._hold_until = self._clock.monotonic() + delay
        _log.warning(
            "record: batch %d of %s was not accepted, sending again in %.1f s: %s",
            entry.seq, entry.stream, delay, error,
        )  # fmt: skip

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
