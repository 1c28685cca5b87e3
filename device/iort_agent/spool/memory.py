"""Where batches wait until the broker has acknowledged them: the only place that keeps them.

`MemorySpool` ends with the process; `iort_agent.spool.sqlite.SqliteSpool` keeps them on disk.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Callable, NamedTuple, Protocol

OVERWRITE_OLDEST, REJECT_NEW = "OverwriteOldestData", "RejectNewData"
# What a batch survives once it may be published: the end of the process, or a power cut too.
PROCESS, FULL = "process", "full"

OnStored = Callable[[], None]


class Entry(NamedTuple):
    """A batch in the spool. ``id`` grows in the order of the puts and is the spool's own."""

    id: int
    stream: str
    seq: int
    payload: bytes
    samples: int


class Backlog(NamedTuple):
    """What is not acknowledged yet."""

    batches: int
    samples: int
    payload_bytes: int


class Dropped(NamedTuple):
    """What the policy has thrown away; a batch on its way meanwhile may have arrived all the same."""

    batches: int
    samples: int


class Spool(Protocol):
    """Keeps batches in order from `put` to `ack`. Safe to use from several threads."""

    @property
    def alarm(self) -> str | None:
        """What the operator should know and mend, in a line; None while all is well."""

    @property
    def durable(self) -> bool:
        """Whether what is left at the end of the process is sent by the next one."""

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler, in any thread, whenever `next` may have a batch that it had not before."""

    def next_seq(self, stream: str) -> int:
        """The number that the stream's next `put` must carry. A durable spool goes on where the run
        before ended; a number whose batch was dropped is not used again, so the loss shows."""

    def put(self, stream: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch, or drop one as the policy says; uses up ``seq`` either way. Never waits for
        a disk: a durable spool gives the batch to `next` when it is durable, and not before."""

    def next(self, after: int) -> Entry | None:
        """The oldest batch with an ``id`` greater than ``after``; it stays until it is acknowledged.
        None where there is none or it is not to hand yet, of which `on_stored` then tells."""

    def ack(self, entry_id: int) -> None:
        """Forget a batch that has arrived. Twice, or after it was dropped, does no harm."""

    def backlog(self) -> Backlog:
        """What is kept now."""

    def dropped(self) -> Dropped:
        """What was dropped since the start of this process."""

    def dropped_ever(self) -> Dropped:
        """What was dropped since the spool was made, by the runs before too."""

    def close(self) -> None:
        """End in good order. What is kept is still there in the next run, if the spool is durable."""


class MemorySpool:
    """A spool that ends with the process. ``max_bytes`` bounds the payloads."""

    alarm: str | None = None
    durable = False

    def __init__(self, *, max_bytes: int, policy: str = OVERWRITE_OLDEST) -> None:
        self._max_bytes = max_bytes
        self._overwrite = policy == OVERWRITE_OLDEST
        self._lock = threading.Lock()
        self._handlers: list[OnStored] = []
        self._entries: OrderedDict[int, Entry] = OrderedDict()
        self._seqs: dict[str, int] = {}
        self._last_id = 0
        self._bytes = self._samples = 0
        self._dropped = Dropped(0, 0)

    def on_stored(self, handler: OnStored) -> None:
        """Call the handler after every put."""
        self._handlers.append(handler)

    def next_seq(self, stream: str) -> int:
        """The number for the stream's next batch, from 0."""
        with self._lock:
            return self._seqs.get(stream, 0)

    def put(self, stream: str, seq: int, payload: bytes, *, samples: int) -> None:
        """Keep a batch; drops it or the oldest ones when there is no room."""
        with self._lock:
            self._seqs[stream] = seq + 1
            self._last_id += 1
            entry = Entry(self._last_id, stream, seq, payload, samples)
            fits = len(payload) <= self._max_bytes
            while self._overwrite and fits and self._bytes + len(payload) > self._max_bytes:
                self._drop(self._remove(next(iter(self._entries))))
            if self._bytes + len(payload) > self._max_bytes:
                self._drop(entry)
                return
            self._entries[entry.id] = entry
            self._bytes += len(payload)
            self._samples += samples
        for handler in self._handlers:
            handler()

    def next(self, after: int) -> Entry | None:
        """The oldest batch after that one; those before it are the few on their way, or none."""
        with self._lock:
            return next((entry for entry_id, entry in self._entries.items() if entry_id > after), None)

    def ack(self, entry_id: int) -> None:
        """Forget a batch."""
        with self._lock:
            if entry_id in self._entries:
                self._remove(entry_id)

    def backlog(self) -> Backlog:
        """What is kept now."""
        with self._lock:
            return Backlog(len(self._entries), self._samples, self._bytes)

    def dropped(self) -> Dropped:
        """What was dropped since the start."""
        with self._lock:
            return self._dropped

    def dropped_ever(self) -> Dropped:
        """The same: nothing is known of the runs before."""
        return self.dropped()

    def close(self) -> None:
        """Nothing to do."""

    def _remove(self, entry_id: int) -> Entry:
        entry = self._entries.pop(entry_id)
        self._bytes -= len(entry.payload)
        self._samples -= entry.samples
        return entry

    def _drop(self, entry: Entry) -> None:
        self._dropped = Dropped(self._dropped.batches + 1, self._dropped.samples + entry.samples)
