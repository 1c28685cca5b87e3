"""Keeps what waits in the ledger: the messages of queues, and asynchronous invocations.

A message comes back as it was sent: visible, and received by nobody yet."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Awaitable, Callable, Iterable
from contextvars import ContextVar
from functools import partial, wraps
from itertools import count
from typing import Any

from ministack.core.responses import AccountRegionScopedDict, get_account_id, get_region
from ministack.services import eventbridge, iot, sqs

from local.persistence.ledger import Ledger

_SCHEMA = """
CREATE TABLE IF NOT EXISTS messages (
    number INTEGER PRIMARY KEY, queue TEXT, id TEXT, text TEXT, UNIQUE (queue, id))
"""
Message = dict[str, Any]


def install(ledger: Ledger) -> None:
    """Keep the messages of each queue from now on, and give a loaded queue its messages back."""
    ledger.define(_SCHEMA)
    queues = sqs._queues = _Queues(ledger)
    ledger.on_undo.append(queues.forget_undone)


class _Queues(AccountRegionScopedDict):  # type: ignore[misc]  # ministack has no types
    """All queues; each that is put in keeps its messages."""

    __slots__ = ("_ledger",)

    def __init__(self, ledger: Ledger) -> None:
        super().__init__()
        self._ledger = ledger

    def __setitem__(self, url: str, queue: dict[str, Any]) -> None:
        super().__setitem__(url, _Queue(self._ledger, url, queue))

    def update(self, other: AccountRegionScopedDict) -> None:
        """Put in queues that the emulator had before its end."""
        for key, queue in other._data.items():
            self._data[key] = _Queue(self._ledger, key[2], queue)

    def forget_undone(self) -> None:
        """Forget the messages that the ledger has undone; whoever sent one is told so."""
        for queue in list(self._data.values()):
            queue["messages"].forget_undone()

    def pop_scoped(self, account_id: str, region: str, key: str, *default: Any) -> Any:
        """Delete a queue with its messages."""
        queue = super().pop_scoped(account_id, region, key, *default)
        if queue is not None:
            queue["messages"].clear()
        return queue


class _Queue(dict[str, Any]):
    """A queue, whose list of messages may be replaced."""

    def __init__(self, ledger: Ledger, url: str, queue: dict[str, Any]) -> None:
        super().__init__(queue)
        rows = ledger.read("SELECT text FROM messages WHERE queue = ? ORDER BY number", (url,))
        super().__setitem__("messages", _Messages(ledger, url, (json.loads(text) for (text,) in rows)))

    def __setitem__(self, name: str, value: Any) -> None:
        if name == "messages":
            self["messages"].replace(value)
        else:
            super().__setitem__(name, value)


class _Messages(list[Message]):
    """The messages of a queue, in their order."""

    def __init__(self, ledger: Ledger, url: str, messages: Iterable[Message] = ()) -> None:
        super().__init__(messages)
        self._ledger, self._url = ledger, url

    def append(self, message: Message) -> None:
        """Raises `LedgerError`, and then the message is not in the queue."""
        with self._ledger.write() as connection:
            values = (self._url, message["id"], json.dumps(message))
            connection.execute("INSERT OR REPLACE INTO messages (queue, id, text) VALUES (?, ?, ?)", values)
            super().append(message)

    def remove(self, message: Message) -> None:
        """Remove one message."""
        self._delete([message])
        super().remove(message)

    def clear(self) -> None:
        """Remove every message."""
        self._delete(self)
        super().clear()

    def replace(self, messages: Iterable[Message]) -> None:
        """Keep these messages, of those that are here, and no others."""
        kept = list(messages)
        names = {message["id"] for message in kept}
        self._delete(message for message in self if message["id"] not in names)
        self[:] = kept

    def forget_undone(self) -> None:
        """Forget the messages that the ledger does not have."""
        known = {
            name for (name,) in self._ledger.read("SELECT id FROM messages WHERE queue = ?", (self._url,))
        }
        self[:] = [message for message in self if message["id"] in known]

    def _delete(self, messages: Iterable[Message]) -> None:
        with self._ledger.write() as connection:
            names = [(self._url, message["id"]) for message in messages]
            connection.executemany("DELETE FROM messages WHERE queue = ? AND id = ?", names)


# Keeps the asynchronous invocations that wait for their function, and those that run.
#
# A message with QoS 0 has no acknowledgement, and neither has the invocation that a rule makes of it.

_log = logging.getLogger(__name__)
_INVOCATIONS = """
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
        ledger.define(_INVOCATIONS)
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
