"""What a spool on disk keeps, in memory: which batches, where, and what has still to be written.

Nothing here touches the disk, waits or locks: whoever has a `Stock` calls it under a lock of its own.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Iterable, NamedTuple

from iort_agent.spool.ledger import Ledger, Size, Window
from iort_agent.spool.memory import Backlog, Dropped, Entry

# A transaction has at most so much in it, so that the log stays small.
GROUP_ENTRIES, GROUP_BYTES = 512, 1024 * 1024
# Read ahead of what is being published. A connection's window of messages is 2.5 MB at most.
AHEAD_BYTES, _WINDOW_BYTES = 512 * 1024, 4 * 1024 * 1024
# Reading goes on when only so many are left: a third of a second at the broker's limit.
_AHEAD_ENTRIES = 32


class Group(NamedTuple):
    """What goes to the disk in one transaction; ``dropped`` is None where it has not changed."""

    entries: list[Entry]
    gone: set[int]
    seqs: dict[str, int]
    dropped: Dropped | None


class Wish(NamedTuple):
    """What to read: from a batch on, which somebody waits for (``afresh``) or soon will."""

    first: int
    afresh: bool


class Stock:
    """``max_bytes`` bounds the payloads, ``memory_bytes`` those that are not on the disk; ``overwrite``
    says whether the oldest or the newest gives way."""

    def __init__(self, *, max_bytes: int, memory_bytes: int, overwrite: bool) -> None:
        self._max_bytes, self._memory_bytes, self._overwrite = max_bytes, memory_bytes, overwrite
        self.ledger = Ledger()
        self.window = Window()
        self._last_id = 0
        self.pending: OrderedDict[int, Entry] = OrderedDict()
        self._pending_bytes = 0
        # Of those being written now the last id: dropped or acknowledged meanwhile, they get deleted.
        self._writing_to = 0
        self._gone: set[int] = set()
        self.seqs: dict[str, int] = {}
        self._used: set[str] = set()
        # Where streams begin that are not known: above 0 only if there are too many to know each.
        self._floor = 0
        self.dropped = self._dropped_before = Dropped(0, 0)
        self._dropped_written = Dropped(0, 0)
        self._wanted: int | None = None
        self._ahead = False
        self._disk_to = 0

    # --- batches come and go ----------------------------------------------------------------------

    def next_seq(self, stream: str) -> int:
        """The number for the stream's next batch."""
        return self.seqs.get(stream, self._floor)

    def put(self, stream: str, seq: int, payload: bytes, samples: int) -> None:
        """Keep a batch; drops it or the oldest ones when there is no room."""
        self.seqs[stream] = seq + 1
        self._used.add(stream)
        size = len(payload)
        if not self._make_room(size):
            self.count_dropped(1, samples)
            return
        self._last_id += 1
        entry = Entry(self._last_id, stream, seq, payload, samples)
        self.ledger.add(entry.id, size, samples)
        self.pending[entry.id] = entry
        self._pending_bytes += size

    def next(self, after: int, *, unwritten: bool) -> tuple[Entry | None, bool]:
        """The oldest batch after that one, if it is in memory and may go out, which one that is not
        written may only if ``unwritten``; and whether `wish` has something to say now."""
        wanted = self.ledger.next(after)
        if wanted is None:
            return None, False
        pending = self.pending.get(wanted)
        if pending is not None:
            return (pending if unwritten else None), False
        entry = self.window.get(wanted)
        if entry is None:
            self._wanted = wanted
            return None, True
        if not self._ahead and wanted + _AHEAD_ENTRIES > self.window.last < self._disk_to:
            self._ahead = True
            return entry, True
        return entry, False

    def forget(self, entry_id: int) -> Size | None:
        """Keep a batch no longer; None if it was not kept."""
        size = self.ledger.remove(entry_id)
        if size is None:
            return None
        self.window.remove(entry_id)
        pending = self.pending.pop(entry_id, None)
        if pending is not None:
            self._pending_bytes -= size.payload_bytes
        if pending is None or entry_id <= self._writing_to:
            self._gone.add(entry_id)
        return size

    def count_dropped(self, batches: int, samples: int) -> None:
        """Count batches that are lost."""
        self.dropped = Dropped(self.dropped.batches + batches, self.dropped.samples + samples)

    def dropped_ever(self) -> Dropped:
        """What was dropped since the spool was made."""
        before, now = self._dropped_before, self.dropped
        return Dropped(before.batches + now.batches, before.samples + now.samples)

    def backlog(self) -> Backlog:
        """What is kept now."""
        return Backlog(self.ledger.batches, self.ledger.samples, self.ledger.payload_bytes)

    def _make_room(self, size: int) -> bool:
        memory = min(self._memory_bytes, self._max_bytes)
        if size > memory:
            return False
        if not self._overwrite:
            fits = self.ledger.payload_bytes + size <= self._max_bytes
            return fits and self._pending_bytes + size <= memory
        while self.ledger.payload_bytes + size > self._max_bytes:
            self._drop(next(iter(self.ledger)))
        # The oldest are on the disk, which does not keep up; dropping those would free no memory.
        while self._pending_bytes + size > memory:
            self._drop(next(iter(self.pending)))
        return True

    def _drop(self, entry_id: int) -> None:
        size = self.forget(entry_id)
        if size is not None:
            self.count_dropped(1, size.samples)

    # --- what has to be written -------------------------------------------------------------------

    @property
    def group_is_full(self) -> bool:
        """Whether a whole transaction waits."""
        return len(self.pending) >= GROUP_ENTRIES or self._pending_bytes >= GROUP_BYTES

    @property
    def unwritten(self) -> bool:
        """Whether the disk lacks anything."""
        return bool(self.pending or self._gone or self._used)

    @property
    def acknowledged(self) -> bool:
        """Whether the disk has batches that are not kept any longer."""
        return bool(self._gone)

    def take_group(self) -> Group | None:
        """What to write next; None if there is nothing. Then comes `written` or `not_written`."""
        entries: list[Entry] = []
        size = 0
        for entry in self.pending.values():
            entries.append(entry)
            size += len(entry.payload)
            if len(entries) >= GROUP_ENTRIES or size >= GROUP_BYTES:
                break
        gone, self._gone = self._gone, set()
        used, self._used = self._used, set()
        seqs = {stream: self.seqs[stream] for stream in used}
        dropped = self.dropped_ever()
        group = Group(entries, gone, seqs, dropped if dropped != self._dropped_written else None)
        if not any(group):
            return None
        self._writing_to = entries[-1].id if entries else 0
        return group

    def not_written(self, group: Group) -> None:
        """The transaction failed."""
        self._gone |= group.gone
        self._used |= group.seqs.keys()
        self._writing_to = 0

    def written(self, group: Group) -> None:
        """A group is on the disk: it may be published, from memory while the window has room."""
        if group.dropped is not None:
            self._dropped_written = group.dropped
        self._writing_to = 0
        entries = group.entries
        kept = [entry for entry in entries if self.pending.pop(entry.id, None) is not None]
        self._pending_bytes -= sum(len(entry.payload) for entry in kept)
        if not entries:
            return
        last, before = entries[-1].id, self._disk_to
        self._disk_to = max(before, last)
        if entries[0].id <= before:
            # The file was opened late: what had waited in memory comes before what was in it.
            self.window.clear()
        elif self.window.last >= before and self.window.payload_bytes < _WINDOW_BYTES // 2:
            self.window.extend(kept, last)

    # --- what has to be read ----------------------------------------------------------------------

    def wish(self) -> Wish | None:
        """What to read from the disk, or None. Then comes `read`, or `ask_again`."""
        wanted, self._wanted = self._wanted, None
        ahead, self._ahead = self._ahead, False
        window = self.window
        if wanted is not None and wanted in self.ledger and window.get(wanted) is None:
            return Wish(wanted, afresh=True)
        if ahead and window.last < self._disk_to and window.payload_bytes < _WINDOW_BYTES // 2:
            return Wish(window.last + 1, afresh=False)
        return None

    def ask_again(self, wish: Wish) -> None:
        """It could not be read now."""
        if wish.afresh:
            self._wanted = wish.first

    def lacks(self, wish: Wish, entries: list[Entry]) -> bool:
        """Whether the batch that is waited for is not among what was read, and should be."""
        return wish.afresh and wish.first in self.ledger and (not entries or entries[0].id != wish.first)

    def read(self, wish: Wish, entries: list[Entry]) -> None:
        """What was read."""
        if wish.afresh:
            self.window.begin(wish.first)
        size = sum(len(entry.payload) for entry in entries)
        last = entries[-1].id if size >= AHEAD_BYTES else self._disk_to
        self.window.extend((entry for entry in entries if entry.id in self.ledger), last)
        self.window.shrink(_WINDOW_BYTES, keep_from=wish.first)

    # --- another file -----------------------------------------------------------------------------

    def ids_behind(self, batches: list[tuple[int, int, int]]) -> int:
        """What to add to the ids in a file, so that they come behind those that are taken already,
        where the agent has run without it."""
        return max(self._last_id, batches[-1][0]) if batches and self._last_id else 0

    def take_over(self, batches: list[tuple[int, int, int]], dropped: Dropped) -> None:
        """Keep what is in a file: id, bytes and samples of each batch, and what was dropped before."""
        for batch in batches:
            self.ledger.add(*batch)
            self._last_id = batch[0]
        self._read_nothing(self._last_id if batches else 0)
        self._dropped_before = dropped

    def go_on_from(self, seqs: dict[str, int], *, floor: int | None = None) -> None:
        """Use no number below these; ``floor`` is for the streams that are not named."""
        if floor is not None:
            self._floor = floor
        for stream, seq in seqs.items():
            self.seqs[stream] = max(self.seqs.get(stream, 0), seq)

    def on_disk(self) -> list[int]:
        """The batches that are kept and written."""
        return [entry_id for entry_id in self.ledger if entry_id not in self.pending]

    def keep_only(self, saved: set[int], of: Iterable[int]) -> int:
        """Of what was on the disk only this could be saved; how many batches are lost."""
        lost = 0
        for entry_id in of:
            if entry_id not in saved and entry_id in self.ledger:
                self._drop(entry_id)
                lost += 1
        self._read_nothing(max(saved, default=0))
        self._gone.intersection_update(saved)
        self._dropped_written = Dropped(-1, -1)
        return lost

    def _read_nothing(self, disk_to: int) -> None:
        """Begin to read ahead anew; the last batch on the disk is that one."""
        self._disk_to = disk_to
        if disk_to:
            self.window.clear()
        else:
            self.window.begin(1)
