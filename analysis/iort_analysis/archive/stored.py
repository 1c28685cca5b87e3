"""The one reader of a stream's recorded batches: in the telemetry table, in the archive, or in both.

The table has every batch until it expires. The archive has every finished hour; an hour is rewritten if
batches arrive late. So until the first batch of an hour is about to expire the table is enough. Later the
archive's hour and what the table has beside it are everything. Callers do not see the difference: the batches
come in the order of their ids.

What cannot be read is passed over, and counted and named in ``refused``: an item that is not a batch, a row
of the manifest, an hour's object. Of a damaged hour the table's items are read, if they are still there.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, TypeAlias, TypeVar

from iort_analysis import ArchiveError
from iort_analysis.archive.hours import Archive, HourFile, Stores, is_expiring, key_of, merged, within
from iort_analysis.samples.batches import (
    ATTRIBUTES,
    Item,
    Part,
    RefusedItems,
    Wanted,
    batches_of,
    part,
    start_us,
)
from iort_analysis.samples.blocks import Block, join
from iort_contract.archive import ArchivedHour, Hour, hour_of, parse_hour
from iort_contract.dynamodb import Keys, starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id
from iort_contract.tables import BATCH, PREVIOUS, RECEIVED_MS, SAMPLES

if TYPE_CHECKING:
    from iort_contract.messages.page import Archived

# Where batches are read: where each is, in the table alone, or in the archive alone.
Source: TypeAlias = Literal["auto", "table", "archive"]
AUTO: Final = "auto"
TABLE: Final = "table"
ARCHIVE: Final = "archive"
HEADER = (BATCH, SAMPLES, RECEIVED_MS, PREVIOUS)
# Hours that are read while the caller uses one, and their samples: 30 fields of half a million take 120 MB.
_HOURS_AHEAD, _SAMPLES_AHEAD = 8, 500_000
_T = TypeVar("_T")
# Receives the number of items in a page, and the start time of its last item in microseconds.
PageProgress = Callable[[int, int], None]


def ahead(items: Iterable[_T]) -> Iterator[_T]:
    """The items; while the caller uses one, a thread reads the next."""
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, iterator, end)
        while (item := coming.result()) is not end:
            coming = reader.submit(next, iterator, end)
            yield item  # type: ignore[misc]  # it is not `end`


class Pages(Generic[_T]):
    """Pages of a table's items in the order of their keys, to be taken up to some key."""

    def __init__(self, pages: Iterator[Sequence[_T]], key: Callable[[_T], Any]) -> None:
        self._pages, self._key = filter(None, pages), key
        self._rest = next(self._pages, ())

    def until(self, key: Any) -> Iterator[Sequence[_T]]:
        """The items before a key; None is all."""
        while self._rest:
            end = len(self._rest) if key is None else bisect_left(self._rest, key, key=self._key)
            if end:
                yield self._rest[:end]
            if end < len(self._rest):
                self._rest = self._rest[end:]
                return
            self._rest = next(self._pages, ())


@dataclass
class Origin:
    """Where a reading found its batches: the hours that it took from the archive."""

    hours: list[Hour] = field(default_factory=list)

    def told(self) -> Archived | None:
        """What came from the archive; None if nothing did."""
        if not self.hours:
            return None
        first, last = min(self.hours), max(self.hours)
        return {"from_us": first.start_us, "to_us": last.end_us, "hours": len(set(self.hours))}

    def within(self, start_us: int | None, end_us: int | None) -> Origin:
        """Only the hours that are partly in a range; the hour before it may have been looked into."""
        return Origin(
            [
                hour
                for hour in self.hours
                if (start_us is None or hour.end_us > start_us) and (end_us is None or hour.start_us < end_us)
            ]
        )


class Stored:
    """The batches of a topic. ``origin`` and ``refused`` grow while they are read."""

    def __init__(
        self,
        stores: Stores,
        topic: str,
        *,
        source: Source = AUTO,
        origin: Origin | None = None,
        refused: RefusedItems | None = None,
    ) -> None:
        self._topic, self._table, self._source = topic, stores.telemetry, source
        self.origin = Origin() if origin is None else origin
        self.refused = RefusedItems() if refused is None else refused
        self.refused.topic = topic
        self._archive = Archive(stores, topic, self.refused)
        self._known: dict[str, list[BatchId]] = {}

    def parts(
        self,
        keys: Keys,
        wanted: Wanted = lambda _name: True,
        *,
        messages: bool = True,
        scan: bool = False,
        progress: PageProgress | None = None,
    ) -> Iterator[Part]:
        """The samples of the batches with these keys, with the fields that are ``wanted``, in the order of
        the batches. Without ``messages``, batches of ROS messages are skipped."""

        def of_hour(hour: HourFile) -> list[Part]:
            return hour.parts(wanted, messages=messages, keys=keys)

        for found in self._found(keys, of_hour, ATTRIBUTES, scan=scan, progress=progress):
            if isinstance(found, _Archived):
                yield from found.content
            elif found:
                yield part(found, self.refused, wanted, messages=messages)

    def items(
        self,
        keys: Keys,
        attributes: Sequence[str] = ATTRIBUTES,
        *,
        page_items: int | None = None,
        progress: PageProgress | None = None,
    ) -> Iterator[Sequence[Item]]:
        """Pages of the stored items with these keys, also of those that are not batches. Those from the
        archive decode to the same batches and messages as the stored ones. ``page_items`` is the most items
        of a page of the table."""
        for found in self._found(
            keys, lambda hour: hour.items(keys), attributes, page_items=page_items, progress=progress
        ):
            yield found.content if isinstance(found, _Archived) else found

    def headers(self, keys: Keys, attributes: Sequence[str] = HEADER) -> Iterator[Item]:
        """The stored items with these keys; those of the archive without their samples."""
        for found in self._found(keys, HourFile.headers, tuple(dict.fromkeys(attributes))):
            yield from within(found.content, keys) if isinstance(found, _Archived) else found

    def batches(self, keys: Keys, wanted: Wanted = lambda _name: True) -> Iterator[Batch]:
        """The batches with these keys, with the fields that are ``wanted``; what is not one is left out."""

        def of_hour(hour: HourFile) -> list[Batch]:
            return hour.batches(wanted, keys)

        for found in self._found(keys, of_hour, (*ATTRIBUTES, PREVIOUS)):
            yield from found.content if isinstance(found, _Archived) else batches_of(found, wanted)

    def after(self, t_us: int | None) -> BatchId | None:
        """The first batch from a time on; None is the oldest of all."""
        found = self._next(starting_between(t_us, None), newest=False)
        ids = (one for row in self._rows(t_us, found and found.t_us) for one in self._ids(row))
        archived = next((one for one in ids if t_us is None or one.t_us >= t_us), None)
        if archived is None or (found is not None and found <= archived):
            return found
        return self._from_archive(archived)

    def before(self, t_us: int | None) -> BatchId | None:
        """The last batch before a time; None is the newest of all."""
        last_us = None if t_us is None else t_us - 1
        found = self._next(starting_between(None, last_us), newest=True)
        rows = self._rows(found and found.t_us, last_us, newest_first=True)
        ids = (one for row in rows for one in reversed(self._ids(row)))
        archived = next((one for one in ids if last_us is None or one.t_us <= last_us), None)
        if archived is None or (found is not None and found >= archived):
            return found
        return self._from_archive(archived)

    def block(self, batch: BatchId, wanted: Wanted = lambda _name: True) -> Block:
        """The samples of one batch; empty if it is not there, or is invalid."""
        return join([found.block for found in self.parts(only(batch), wanted)])

    def archived(self, keys: Keys) -> list[Hour]:
        """The hours that are read from the archive for these keys."""
        return [] if keys.empty else [parse_hour(row.hour) for row in self._rows(*_times(keys))]

    @property
    def reads_table(self) -> bool:
        """Whether the table is read, too."""
        return self._source != ARCHIVE

    def _found(
        self,
        keys: Keys,
        read: Callable[[HourFile], _T],
        attributes: Sequence[str],
        *,
        scan: bool = False,
        page_items: int | None = None,
        progress: PageProgress | None = None,
    ) -> Iterator[_Archived[_T] | Sequence[Item]]:
        """Pages of items, and what ``read`` makes of hours in the archive, in the order of the batches."""
        if keys.empty:
            return
        pool = ThreadPoolExecutor(_HOURS_AHEAD)
        try:
            listed = pool.submit(lambda: list(self._rows(*_times(keys))))
            # Meanwhile the first page is read, which is nearly always needed.
            table = Pages(self._pages(keys, attributes, scan=scan, page_items=page_items), key_of)
            for row, content in self._ahead(pool, listed.result(), read):
                hour = parse_hour(row.hour)
                for items in table.until(_first_key(hour.start_us)):
                    yield _told(items, progress)
                beside = [item for items in table.until(_first_key(hour.end_us)) for item in items]
                try:
                    read_ahead = None if content is None else content.result()
                    found = self._with(beside, row, read_ahead, keys)
                except ArchiveError as error:
                    self.refused.add(error, f"{row.samples:,} samples of {row.hour}")
                    found = beside
                    if not beside:
                        continue
                if isinstance(found, _Archived) and not found.content:
                    continue
                self.origin.hours.append(hour)
                if progress is not None:
                    progress(row.batches, hour.end_us)
                yield found
            for items in table.until(None):
                yield _told(items, progress)
        finally:
            pool.shutdown(cancel_futures=True)

    def _rows(
        self, first_us: int | None, last_us: int | None, *, newest_first: bool = False
    ) -> Iterator[ArchivedHour]:
        """The hours to read from the archive, of batches that start between two times."""
        if self._source == TABLE:
            return
        for row in self._archive.rows(first_us, last_us, newest_first=newest_first):
            if self._source == ARCHIVE or is_expiring(row):
                yield row

    def _pages(
        self, keys: Keys, attributes: Sequence[str], *, scan: bool, page_items: int | None
    ) -> Iterator[Sequence[Item]]:
        if not self.reads_table:
            return
        pages = self._table.pages(self._topic, keys, attributes=attributes, scan=scan, page_items=page_items)
        found: Iterator[Sequence[Item]] = (page.items for page in pages if page.items)
        if scan:
            # A scan has no order.
            found = iter([sorted(chain.from_iterable(found), key=key_of)])
        yield from ahead(found)

    def _ahead(
        self, pool: ThreadPoolExecutor, rows: Sequence[ArchivedHour], read: Callable[[HourFile], _T]
    ) -> Iterator[tuple[ArchivedHour, Future[_T] | None]]:
        """The hours with what ``read`` makes of them; while the caller uses one, the next ones are read."""
        coming: deque[tuple[ArchivedHour, Future[_T] | None]] = deque()
        left = deque(rows)
        while coming or left:
            while left and len(coming) < _HOURS_AHEAD:
                if coming and sum(row.samples for row, _ in coming) + left[0].samples > _SAMPLES_AHEAD:
                    break
                row = left.popleft()
                # An hour with anything else than batches is read in `_with`.
                content = None if row.refused else pool.submit(self._archive.read, row, read)
                coming.append((row, content))
            row, content = coming.popleft()
            yield row, content

    def _with(
        self, beside: Sequence[Item], row: ArchivedHour, content: _T | None, keys: Keys
    ) -> _Archived[_T] | Sequence[Item]:
        """What an hour holds in the archive and ``beside`` it in the table."""
        if beside:
            archived = set(self._archive.read(row, HourFile.ids))
            beside = [item for item in beside if key_of(item) not in archived]
        if not beside and content is not None:
            return _Archived(content)
        # Rare and slow: batches that came late, or items that are not batches.
        return within(merged(beside, self._archive.read(row, lambda hour: hour.items(keys))), keys)

    def _from_archive(self, batch: BatchId) -> BatchId:
        self.origin.hours.append(hour_of(batch.t_us))
        return batch

    def _ids(self, row: ArchivedHour) -> list[BatchId]:
        if row.hour not in self._known:
            ids: list[BatchId] = []
            try:
                ids += _batch_ids(self._archive.read(row, HourFile.ids))
            except ArchiveError as error:
                self.refused.add(error, f"{row.samples:,} samples of {row.hour}")
            # Once it is complete: several threads may ask.
            self._known[row.hour] = ids
        return self._known[row.hour]

    def _next(self, keys: Keys, *, newest: bool) -> BatchId | None:
        """The table's first or last batch with one of these keys."""
        if not self.reads_table:
            return None
        pages = self._table.pages(self._topic, keys, attributes=(BATCH,), page_items=1, newest_first=newest)
        # What is not a batch has no time.
        return next((one for page in pages for one in _batch_ids(map(key_of, page.items))), None)


@dataclass(frozen=True)
class _Archived(Generic[_T]):
    """What was made of an hour in the archive."""

    content: _T


def only(batch: BatchId) -> Keys:
    """The key of one batch."""
    return Keys({"S": str(batch)}, {"S": str(batch)}, empty=False)


def _told(items: Sequence[Item], progress: PageProgress | None) -> Sequence[Item]:
    if progress is not None:
        progress(len(items), start_us(items[-1]))
    return items


def _first_key(t_us: int) -> str:
    return starting_between(t_us, None).first["S"]


def _times(keys: Keys) -> tuple[int, int]:
    """The times with which the first and the last key begin."""
    return int(keys.first["S"][:16]), int(keys.last["S"][:16])


def _batch_ids(keys: Iterable[str]) -> Iterator[BatchId]:
    for key in keys:
        with suppress(ContractError):
            yield batch_id(key)
