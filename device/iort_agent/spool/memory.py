"""The batches that a spool has in memory, in order, and within a bound."""

from __future__ import annotations

import threading
from collections import OrderedDict

from iort_agent.spool import OVERWRITE_OLDEST, Backlog, Dropped, Entry


class Memory:
    """Batches by their ids. ``max_bytes`` bounds the ``payload_bytes``; ``last_id`` is the id of the last
    batch."""

    def __init__(self, *, max_bytes: int, policy: str = OVERWRITE_OLDEST) -> None:
        self.max_bytes = max_bytes
        self.last_id = 0
        self._overwrite = policy == OVERWRITE_OLDEST
        self._lock = threading.Lock()
        self._entries: OrderedDict[int, Entry] = OrderedDict()
        self.payload_bytes = self._samples = 0
        self._dropped = Dropped(0, 0)

    def __len__(self) -> int:
        """How many batches are kept."""
        return len(self._entries)

    def put(self, stream: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch; drops it or the oldest ones when there is no room."""
        with self._lock:
            self.last_id += 1
            entry = Entry(self.last_id, stream, seq, payload, samples)
            size = len(payload)
            while self._overwrite and size <= self.max_bytes < self.payload_bytes + size:
                self._drop(self._remove(next(iter(self._entries))))
            if self.payload_bytes + size > self.max_bytes:
                self._drop(entry)
                return
            self._entries[entry.id] = entry
            self.payload_bytes += size
            self._samples += samples

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

    def backlog(self) -> Backlog:
        """What is kept now."""
        with self._lock:
            return Backlog(len(self._entries), self._samples, self.payload_bytes)

    def dropped(self) -> Dropped:
        """What was dropped since the start."""
        with self._lock:
            return self._dropped

    def _remove(self, entry_id: int) -> Entry:
        entry = self._entries.pop(entry_id)
        self.payload_bytes -= len(entry.payload)
        self._samples -= entry.samples
        return entry

    def _drop(self, entry: Entry) -> None:
        self._dropped = Dropped(self._dropped.batches + 1, self._dropped.samples + entry.samples)
