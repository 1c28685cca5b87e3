"""Where an import's batches go: into the telemetry table, as the rule `record` puts them there, or into the
archive's hours, as the archive's function writes them."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from io import SEEK_END
from itertools import chain, groupby, pairwise
from tempfile import TemporaryFile
from typing import IO, Any, Protocol

import numpy as np
import pyarrow as pa

from iort_analysis.archive import columns as names
from iort_analysis.archive.columns import runs
from iort_analysis.archive.hours import key_of
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import (
    Piece,
    Pieces,
    Spool,
    described,
    in_order,
    joined_kinds,
    pieces,
    write_pieces,
)
from iort_contract.archive import (
    ArchivedHour,
    ArchiveTable,
    Hour,
    Pending,
    content_hash,
    hour_key,
    hour_of,
    item_hash,
    refused_key,
)
from iort_contract.dynamodb import Item, Keys
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id
from iort_contract.objects import CHANGED, Objects, Read, code_of
from iort_contract.tables import BATCH, EXPIRES_S, RECEIVED_MS, SAMPLES, TOPIC
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.recorded import telemetry_table, topic_of, write
from iort_station.errors import StationError

TABLE, ARCHIVE = "table", "archive"
# The archive's function joins the day's hours and compresses them again.
_LEVEL = 2
# Each failure means that another one has written the hour: the archive's function, or another import.
_ATTEMPTS = 10
# Hours that begin later wait in another temporary file.
_SCRATCH_BYTES = 256 * 1024 * 1024


class Store(Protocol):
    """Takes the batches of one robot, stream by stream; whole messages as pieces if it ``takes_pieces``."""

    takes_pieces: bool

    def items(self, stream: str, items: Sequence[Item]) -> None:
        """Take batches as stored items, in order of time."""

    def piece(self, stream: str, hour: Hour, one: Piece, hashes: Sequence[tuple[str, str]]) -> None:
        """Take an hour's batches, and the hashes of their contents by their ids."""

    def flush(self, before: Hour | None) -> None:
        """Write the hours before one, to which nothing comes any more; None is all."""


def item_of(topic: str, batch: Batch, payload: Any, received_ms: int, expires_s: int) -> Item:
    """A batch's message as the rule stores it."""
    item: Item = {
        name: {"N": str(value)} if isinstance(value, int) else {"S": value} for name, value in payload.items()
    }
    assert item[SAMPLES] == {"N": str(len(batch.times_us))}
    return {
        **item,
        TOPIC: {"S": topic},
        RECEIVED_MS: {"N": str(received_ms)},
        EXPIRES_S: {"N": str(expires_s)},
    }


class TableStore:
    """Writes batches into the table, at so many write units a second. Lambda 2 makes their seconds."""

    takes_pieces = False

    def __init__(self, cloud: Cloud, units_per_s: int, *, again: bool) -> None:
        self._cloud, self._units, self._again = cloud, units_per_s, again
        self._table = telemetry_table(cloud)

    def items(self, stream: str, items: Sequence[Item]) -> None:
        if self._again and items:
            keys = Keys(items[0][BATCH], items[-1][BATCH], empty=False)
            topic = topic_of(self._cloud, parse_topic(items[0][TOPIC]["S"]).robot, stream)
            pages = self._table.pages(topic, keys, attributes=(BATCH,))
            there = {key_of(item) for page in pages for item in page.items}
            items = [item for item in items if key_of(item) not in there]
        write(self._table, items, self._units)

    def piece(self, stream: str, hour: Hour, one: Piece, hashes: Sequence[tuple[str, str]]) -> None:
        raise NotImplementedError("the table takes items")

    def flush(self, before: Hour | None) -> None:
        """Everything is written already."""


@dataclass
class _Open:
    """An hour of a stream that may still get batches: its pieces, and the ids and hashes of their batches."""

    scratch: IO[bytes]
    spool: Spool
    hashes: dict[str, str] = field(default_factory=dict)
    spans: list[tuple[str, str]] = field(default_factory=list)
    attempts: int = 1

    def is_ordered(self) -> bool:
        """Whether the pieces are in the order of their batches."""
        return all(before[1] < after[0] for before, after in pairwise(self.spans))


class ArchiveStore:
    """Writes batches into the archive's hours, beside what is there."""

    takes_pieces = True

    def __init__(self, cloud: Cloud, robot: str) -> None:
        self._cloud, self._robot = cloud, robot
        self._manifest = ArchiveTable(cloud.client("dynamodb"), cloud.output("storage", "ArchiveTable"))
        self._objects = Objects(cloud.client("s3"), cloud.output("storage", "FilesBucket"))
        self._open: dict[tuple[str, Hour], _Open] = {}
        self._scratches: list[IO[bytes]] = []
        self.hours = 0
        self.size_bytes = 0

    def items(self, stream: str, items: Sequence[Item]) -> None:
        def refuse(_item: Item, reason: str) -> None:
            raise StationError(f"{stream}: a batch of the import cannot be read: {reason}")

        for hour, some in groupby(items, key=lambda item: hour_of(batch_id(item[BATCH]["S"]).t_us)):
            own = list(some)
            hashes = [(key_of(item), item_hash(item)) for item in own]
            for one in pieces(own, refuse):
                self.piece(stream, hour, one, hashes)

    def piece(self, stream: str, hour: Hour, one: Piece, hashes: Sequence[tuple[str, str]]) -> None:
        key = stream, hour
        if key not in self._open:
            # A file each would be too many open ones, and one for all would only grow.
            if not self._scratches or self._scratches[-1].seek(0, SEEK_END) > _SCRATCH_BYTES:
                self._scratches.append(TemporaryFile())  # noqa: SIM115 - closed with the last hour in it
            scratch = self._scratches[-1]
            self._open[key] = _Open(scratch, Spool(scratch))
        to = self._open[key]
        to.spool.add(one)
        to.hashes.update(hashes)
        to.spans.append((hashes[0][0], hashes[-1][0]))

    def flush(self, before: Hour | None) -> None:
        for stream, hour in sorted(self._open, key=lambda key: (key[1], key[0])):
            if before is None or hour < before:
                self._write(stream, hour, self._open[stream, hour])
                del self._open[stream, hour]
        self._close({id(one.scratch) for one in self._open.values()})

    def close(self) -> None:
        """Forget what is not written."""
        self._open.clear()
        self._close(set())

    def _close(self, but: Collection[int]) -> None:
        for one in self._scratches:
            if id(one) not in but:
                one.close()
        self._scratches = [one for one in self._scratches if not one.closed]

    def is_open(self) -> bool:
        """Whether hours wait to be written."""
        return bool(self._open)

    def _write(self, stream: str, hour: Hour, new: _Open) -> None:
        topic = topic_of(self._cloud, self._robot, stream)
        while not self._is_written(topic, hour, new):
            new.attempts += 1

    def _is_written(self, topic: str, hour: Hour, new: _Open) -> bool:
        try:
            self._write_once(topic, hour, new)
        except Exception as error:
            # An hour's object goes when it is joined to its day.
            changed = code_of(error) in {*CHANGED, "ConditionalCheckFailedException", "NoSuchKey"}
            if not changed or new.attempts >= _ATTEMPTS:
                raise
            return False
        return True

    def _write_once(self, topic: str, hour: Hour, new: _Open) -> None:
        named = parse_topic(topic)
        key = hour_key(named, hour)
        # Before the row, which may be newer than this version and never older.
        version = self._objects.version(key)
        row = self._row(topic, hour)
        with ExitStack() as files:
            there = _There(
                self._objects, key if version is not None else "", row, hour, new=new.hashes, files=files
            )
            if not there.is_newer and new.hashes.keys() <= there.hashes.keys():
                return
            hashes = {**new.hashes, **there.hashes}
            some = there.beside(new)
            into = files.enter_context(TemporaryFile())
            write_pieces(some, into, hour, described(named.name), level=_LEVEL)
            samples = ArchiveFile(into).rows
            sha256, size = self._objects.write(key, into, version)
        before, now_ms = row, time.time_ns() // 1_000_000
        refused = 0 if before is None else before.refused
        # The day's object, if there is one, is now old.
        self._manifest.mark(Pending(topic, hour.date), now_ms)
        # The table does not have them, as if they had expired there.
        expires_s = min(now_ms // 1000, (before.first_expires_s if before else 0) or now_ms // 1000)
        content = content_hash(sorted(hashes.items()))
        self._manifest.keep(
            ArchivedHour(
                topic,
                str(hour),
                key,
                len(hashes) - refused,
                samples,
                refused,
                content,
                sha256,
                size,
                now_ms,
                expires_s,
            ),
            before,
        )
        self.hours += 1
        self.size_bytes += size

    def _row(self, topic: str, hour: Hour) -> ArchivedHour | None:
        try:
            return self._manifest.row(topic, hour)
        except ContractError as error:
            raise StationError(
                f"the archive's row of {topic} {hour} is damaged: {error}; run `iort archive verify`"
            ) from error


def _damaged(row: ArchivedHour) -> StationError:
    return StationError(
        f"{row.key} is not the object that was archived: if the archive's function writes it now, import "
        "again in an hour; otherwise run `iort archive verify`"
    )


class _There:
    """What the archive has of an hour already: the hashes by the ids of its batches, and its file.

    The hour's object may have more than its row says: an import that runs now, or was killed, has written the
    object, and not the row. What is written next must have that, too.
    """

    def __init__(
        self,
        objects: Objects,
        key: str,
        row: ArchivedHour | None,
        hour: Hour,
        *,
        new: Collection[str],
        files: ExitStack,
    ) -> None:
        """``key`` is that of the hour's object, empty without one; ``new`` are the ids of the import's
        batches."""
        self._hour = hour
        # Whether it was written after its row.
        self.is_newer = False
        self.hashes: dict[str, str] = {}
        self._batches: dict[str, str] = {}
        self._file: ArchiveFile | None = None
        if row is not None and row.refused:
            # What was no batch stays in an object of its own.
            lines = files.enter_context(objects.read(refused_key(parse_topic(row.topic), hour)).file)
            self.hashes.update({key_of(item): item_hash(item) for item in map(json.loads, lines)})
        named = "" if row is None else row.key
        for one in dict.fromkeys((key, named)):
            if one and self._takes(objects.read(one), row, new, files):
                return
            if one and one == named:
                assert row is not None, "it has a key"
                raise _damaged(row)

    def _takes(self, read: Read, row: ArchivedHour | None, new: Collection[str], files: ExitStack) -> bool:
        """Take an object as the hour's, if it has what the row says; whether it does."""
        file = files.enter_context(read.file)
        try:
            opened = ArchiveFile(file)
            batches = dict(opened.hashes(self._hour))
        except (ContractError, ValueError, OSError, KeyError):
            return False
        is_newer = row is None or read.sha256 != row.sha256
        if is_newer and row is not None and not _follows(row, {**self.hashes, **batches}, batches, new):
            return False
        self._file, self._batches, self.is_newer = opened, batches, is_newer
        self.hashes.update(batches)
        return True

    def beside(self, new: _Open) -> Pieces:
        """The hour's pieces with new ones, in the order of their batches. Those that are there already stay
        as they are."""
        mine = new.spool.pieces()
        if self._file is None or not self._batches:
            return mine if new.is_ordered() else _sorted(mine)
        file, groups = self._file, self._file.groups(self._hour)
        there = (Piece(file.table(group), file.kinds, 0) for group in groups)
        kinds = joined_kinds((file.kinds, mine.kinds))
        parts = [
            there,
            self._lacking(mine.pieces) if new.hashes.keys() & self._batches.keys() else mine.pieces,
        ]
        number = len(groups) + mine.number
        follows = min(new.hashes) > max(self._batches)
        if new.is_ordered() and (follows or max(new.hashes) < min(self._batches)):
            return Pieces(chain.from_iterable(parts if follows else parts[::-1]), number, kinds)
        return _sorted(Pieces(chain.from_iterable(parts), number, kinds))

    def _lacking(self, some: Iterable[Piece]) -> Iterator[Piece]:
        for one in some:
            ids, rows = runs(one.table[names.BATCH_ID])
            kept = [each not in self.hashes for each in ids]
            if any(kept):
                yield one._replace(table=one.table.filter(pa.array(np.repeat(kept, np.diff(rows)))))


def _follows(
    row: ArchivedHour, hashes: Mapping[str, str], batches: Collection[str], new: Collection[str]
) -> bool:
    """Whether an object has what the row says, and perhaps more: the ``new`` batches, and those of one run
    from some number on, of an import that has written the object, perhaps several times, and not the row."""
    every, runs_there = sorted(hashes.items()), defaultdict[str, list[BatchId]](list)
    for one in map(batch_id, batches):
        runs_there[one.boot].append(one)

    def added() -> Iterator[set[str]]:
        yield set()
        for some in runs_there.values():
            for first in sorted({one.seq for one in some}):
                yield {str(one) for one in some if one.seq >= first}

    return any(
        content_hash(one for one in every if one[0] not in more) == row.content
        for some in added()
        for more in (some, some.union(new))
    )


def _sorted(some: Pieces) -> Pieces:
    """Pieces in the order of their batches, all in memory; those that lie among each other become one."""
    spans = []
    for one in some.pieces:
        ids = runs(one.table[names.BATCH_ID])[0]
        spans.append((min(ids), max(ids), one))
    spans.sort(key=lambda span: span[0])
    groups: list[list[Piece]] = []
    last = ""
    for first, end, one in spans:
        if groups and first <= last:
            groups[-1].append(one)
        else:
            groups.append([one])
        last = max(last, end)
    every = [group[0] if len(group) == 1 else in_order(group) for group in groups]
    return Pieces(every, len(every), some.kinds)
