"""A spool in memory, which ends with the process."""

from __future__ import annotations

import threading
from collections import OrderedDict

from iort_agent.spool.interface import OVERWRITE_OLDEST, Backlog, Dropped, Entry, OnStored
from iort_contract.messages.batch import RunEnd


def changed(kept: Backlog, batches: int, samples: int, payload_bytes: int) -> Backlog:
    """What is kept, after so much has come or, below 0, gone."""
    return Backlog(kept.batches + batches, kept.samples + samples, kept.payload_bytes + payload_bytes)


class MemorySpool:
    """A spool that ends with the process. ``max_bytes`` bounds the payloads; ``last_id`` is the id of the
    last batch that was put."""

    alarm: str | None = None
    damaged = 0
    durable = False

    def __init__(self, *, max_bytes: int, policy: str = OVERWRITE_OLDEST) -> None:
        self.max_bytes = max_bytes
        self.last_id = 0
        self._overwrite = policy == OVERWRITE_OLDEST
        self._lock = threading.Lock()
        self._handlers: list[OnStored] = []
        self._entries: OrderedDict[int, Entry] = OrderedDict()
        self._kept = Backlog(0, 0, 0)
        self._dropped = Dropped(0, 0)
        self._arrived: set[str] = set()

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler after every put."""
        self._handlers.append(handler)

    def previous(self, stream: str) -> tuple[RunEnd, ...] | None:
        """No runs: they are not known."""
        with self._lock:
            return None if stream in self._arrived else ()

    def put(self, stream: str, boot: str, seq: int, payload: bytes, *, samples: int) -> None:  # noqa: ARG002 - it knows no runs
        """Keep a batch; drops it or the oldest ones when there is no room."""
        with self._lock:
            self.last_id += 1
            entry = Entry(self.last_id, stream, seq, payload, samples)
            size = len(payload)
            while self._overwrite and size <= self.max_bytes < self._kept.payload_bytes + size:
                self._drop(self._remove(next(iter(self._entries))))
            if self._kept.payload_bytes + size > self.max_bytes:
                self._drop(entry)
                return
            self._entries[entry.id] = entry
            self._kept = changed(self._kept, 1, samples, size)
        for handler in self._handlers:
            handler()

    def next(self, after: int) -> Entry | None:
        """The oldest batch after that one."""
        with self._lock:
            # Only the few batches that are being published come before it.
            return next((entry for entry_id, entry in self._entries.items() if entry_id > after), None)

    def oldest(self, max_batches: int, max_bytes: int) -> list[Entry]:
        """The oldest batches, until they reach one of the limits."""
        entries: list[Entry] = []
        size = 0
        with self._lock:
            for entry in self._entries.values():
                entries.append(entry)
                size += len(entry.payload)
                if len(entries) >= max_batches or size >= max_bytes:
                    break
        return entries

    def take(self, entry_id: int) -> Entry | None:
        """Remove a batch and return it; None if it is not here."""
        with self._lock:
            return self._remove(entry_id) if entry_id in self._entries else None

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        entry = self.take(entry_id)
        if entry is not None:
            with self._lock:
                self._arrived.add(entry.stream)

    def backlog(self) -> Backlog:
        """What is kept now."""
        with self._lock:
            return self._kept

    def dropped(self) -> Dropped:
        """What was dropped since the start."""
        with self._lock:
            return self._dropped

    def close(self) -> None:
        """Nothing to do."""

    def _remove(self, entry_id: int) -> Entry:
        entry = self._entries.pop(entry_id)
        self._kept = changed(self._kept, -1, -entry.samples, -len(entry.payload))
        return entry

    def _drop(self, entry: Entry) -> None:
        self._dropped = Dropped(self._dropped.batches + 1, self._dropped.samples + entry.samples)
