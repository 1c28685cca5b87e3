"""Keeps the messages of queues in the ledger.

A message comes back as it was sent: visible, and received by nobody yet.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from ministack.core.responses import AccountRegionScopedDict
from ministack.services import sqs

from local.keeping.ledger import Ledger

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
