"""What a spool on disk remembers in memory: a few bytes of every batch, and the next few batches."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from typing import Iterable, Iterator, NamedTuple

from iort_agent.spool.memory import Entry

_GONE = -1
_SHRINK_FROM = 1024


class Size(NamedTuple):
    """What of a batch is counted."""

    payload_bytes: int
    samples: int


class Ledger:
    """Ids and sizes of the batches kept, in order of their ids: 24 bytes a batch."""

    def __init__(self) -> None:
        self._ids, self._bytes, self._samples = array("q"), array("q"), array("q")
        # Everything before it is gone; the batch at it is not.
        self._head = 0
        self.batches = self.samples = self.payload_bytes = 0

    def add(self, entry_id: int, payload_bytes: int, samples: int) -> None:
        """Note a batch; its id is greater than any noted before."""
        self._ids.append(entry_id)
        self._bytes.append(payload_bytes)
        self._samples.append(samples)
        self.batches += 1
        self.samples += samples
        self.payload_bytes += payload_bytes

    def remove(self, entry_id: int) -> Size | None:
        """Forget a batch; None if it is not here."""
        i = self._find(entry_id)
        if i is None:
            return None
        size = Size(self._bytes[i], self._samples[i])
        self._bytes[i] = _GONE
        self.batches -= 1
        self.samples -= size.samples
        self.payload_bytes -= size.payload_bytes
        while self._head < len(self._ids) and self._bytes[self._head] == _GONE:
            self._head += 1
        if self._head >= _SHRINK_FROM and self._head * 2 >= len(self._ids):
            for column in (self._ids, self._bytes, self._samples):
                del column[: self._head]
            self._head = 0
        return size

    def __contains__(self, entry_id: int) -> bool:
        return self._find(entry_id) is not None

    def __iter__(self) -> Iterator[int]:
        return (self._ids[i] for i in range(self._head, len(self._ids)) if self._bytes[i] != _GONE)

    def next(self, after: int) -> int | None:
        """The id of the oldest batch after that one."""
        i = bisect_right(self._ids, after, self._head)
        while i < len(self._ids) and self._bytes[i] == _GONE:
            i += 1
        return self._ids[i] if i < len(self._ids) else None

    def _find(self, entry_id: int) -> int | None:
        i = bisect_left(self._ids, entry_id, self._head)
        here = i < len(self._ids) and self._ids[i] == entry_id and self._bytes[i] != _GONE
        return i if here else None


class Window:
    """Batches read ahead: every one on the disk whose id is from ``first`` to ``last`` is here."""

    def __init__(self) -> None:
        self._entries: OrderedDict[int, Entry] = OrderedDict()
        self.payload_bytes = 0
        self.first, self.last = 1, 0

    def get(self, entry_id: int) -> Entry | None:
        """The batch, if it is here."""
        return self._entries.get(entry_id)

    def clear(self) -> None:
        """Hold nothing."""
        self._entries.clear()
        self.payload_bytes = 0
        self.first, self.last = 0, -1

    def begin(self, first: int) -> None:
        """Hold nothing, to be extended from an id on."""
        self.clear()
        self.first, self.last = first, first - 1

    def extend(self, entries: Iterable[Entry], last: int) -> None:
        """Take the batches that follow, up to that id."""
        for entry in entries:
            self._entries[entry.id] = entry
            self.payload_bytes += len(entry.payload)
        self.last = last

    def remove(self, entry_id: int) -> None:
        """Forget a batch, if it is here."""
        entry = self._entries.pop(entry_id, None)
        if entry is not None:
            self.payload_bytes -= len(entry.payload)

    def shrink(self, payload_bytes: int, keep_from: int) -> None:
        """Let go of the oldest until it holds no more than that, but of none from an id on."""
        while self.payload_bytes > payload_bytes:
            oldest = next(iter(self._entries))
            if oldest >= keep_from:
                return
            self.remove(oldest)
            self.first = oldest + 1
