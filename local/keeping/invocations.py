"""Keeps the asynchronous invocations that wait for their function, and those that run.

A message with QoS 0 has no acknowledgement, and neither has the invocation that a rule makes of it.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from functools import partial, wraps
from itertools import count
from typing import Any

from ministack.core.responses import get_account_id, get_region
from ministack.services import eventbridge, iot

from local.keeping.ledger import Ledger

_log = logging.getLogger(__name__)
_SCHEMA = """
CREATE TABLE IF NOT EXISTS invocations (
    number INTEGER PRIMARY KEY, account TEXT, region TEXT, function TEXT, event TEXT, queued_s REAL)
"""
# Messages of AWS IoT itself, of which ministack gives no QoS.
_OWN = "$aws/"
_acknowledged: ContextVar[bool] = ContextVar("acknowledged", default=True)
# Queues one event in memory by account, region, function and event, and calls ``done`` at its end.
Queue = Callable[..., None]


class Invocations:
    """A queue of events for each function, in the ledger; a function gets each event at least once."""

    def __init__(self, ledger: Ledger, queue: Queue) -> None:
        self._ledger, self._queue = ledger, queue
        ledger.define(_SCHEMA)
        ((last,),) = ledger.read("SELECT coalesce(max(number), 0) FROM invocations")
        # SQLite would give the number of an undone row again, while that event still runs.
        self._numbers = count(last + 1)

    def install(self) -> None:
        """Keep what rules and schedules invoke from now on."""
        iot._dispatch_rule_to_lambda = self.dispatch
        eventbridge._dispatch_to_lambda = self.dispatch_scheduled
        iot.broker_publish = _noting_acknowledgement(iot.broker_publish)

    def dispatch_scheduled(self, function: str, payload: str) -> None:
        """Queue the event of a schedule."""
        self.dispatch(get_account_id(), get_region(), function, json.loads(payload))

    def dispatch(self, account: str, region: str, function_arn: str, event: Any) -> None:
        """Queue one event; raises `LookupError` for an unknown function, or `LedgerError`."""
        if not _acknowledged.get():
            self._queue(account, region, function_arn, event)
            return
        with self._ledger.write() as connection:
            number = next(self._numbers)
            connection.execute(
                "INSERT INTO invocations VALUES (?, ?, ?, ?, ?, ?)",
                (number, account, region, function_arn, json.dumps(event), time.time()),
            )
            self._queue(account, region, function_arn, event, done=partial(self._remove, number))

    def go_on(self) -> None:
        """Queue again what was waiting, or running, when the emulator ended."""
        rows = self._ledger.read("SELECT * FROM invocations ORDER BY number")
        for number, account, region, function, event, _ in rows:
            done = partial(self._remove, number)
            try:
                # Its age begins anew: it could not run while the emulator was off.
                self._queue(account, region, function, json.loads(event), done=done)
            except LookupError as error:
                _log.warning("an event is given up: %s", error)
                done()

    def _remove(self, number: int) -> None:
        with self._ledger.write() as connection:
            connection.execute("DELETE FROM invocations WHERE number = ?", (number,))


def _noting_acknowledgement(publish: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        token = _acknowledged.set(bool(rest.get("qos")) or topic.startswith(_OWN))
        try:
            await publish(account, region, topic, payload, **rest)
        finally:
            _acknowledged.reset(token)

    return broker_publish
