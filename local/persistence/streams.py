"""The records of DynamoDB's streams, and how far each mapping has come, in the ledger."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial, wraps
from itertools import takewhile
from typing import Any, overload

from ministack.services import dynamodb, lambda_svc

from local.persistence.ledger import Ledger
from local.persistence.tables import Tables, gently

Record = dict[str, Any]

# A record's row is its stream's number and its place in the stream: reading on needs no other index.
_SCHEMA = """
CREATE TABLE IF NOT EXISTS streams (id INTEGER PRIMARY KEY, arn TEXT UNIQUE NOT NULL);
CREATE TABLE IF NOT EXISTS records (
    id INTEGER PRIMARY KEY, at_s REAL NOT NULL, record TEXT NOT NULL, new TEXT);
CREATE TABLE IF NOT EXISTS marks (mapping TEXT PRIMARY KEY, arn TEXT NOT NULL, position INTEGER NOT NULL)
"""
_SPAN = 1 << 40
_RETENTION_S = 24 * 3600
_TRIMMED_ROWS = 500


def install(ledger: Ledger) -> Streams:
    """Let ministack keep items and streams in the ledger."""
    tables = Tables(ledger)
    tables.install()
    streams = Streams(tables)
    streams.install()
    return streams


class Streams:
    """All streams. ministack counts the records of a stream from 0; the count goes on after a restart."""

    def __init__(self, tables: Tables) -> None:
        self.tables, self.ledger = tables, tables.ledger
        self._streams: dict[str, Stream] = {}
        self.ledger.define(_SCHEMA)
        self.ledger.on_undo.append(self._streams.clear)

    def install(self) -> None:
        """Let ministack keep its records here."""
        dynamodb._stream_records = self
        dynamodb._trim_stream_records = lambda *_, **__: None
        dynamodb.stream_start_position = lambda *of, **scope: self.of(*of, **scope).start
        dynamodb.stream_end_position = lambda *of, **scope: self.of(*of, **scope).end
        dynamodb.stream_records_since = self.since
        dynamodb.stream_live_records = self.of
        dynamodb._expire_items = self._trimming(dynamodb._expire_items)
        dynamodb.drop_stream_records = self._dropping(dynamodb.drop_stream_records)

    def of(self, name: str, *, account_id: str | None = None, region: str | None = None) -> Stream:
        """A table's stream."""
        scoped = account_id is not None and region is not None
        table = (
            dynamodb._tables.get_scoped(account_id, region, name) if scoped else dynamodb._tables.get(name)
        )
        return self._stream((table or {}).get("LatestStreamArn") or name)

    def _stream(self, arn: str) -> Stream:
        stream = self._streams.get(arn)
        if stream is None:
            with self.ledger.write() as connection:
                connection.execute("INSERT OR IGNORE INTO streams (arn) VALUES (?)", (arn,))
                ((number,),) = connection.execute("SELECT id FROM streams WHERE arn = ?", (arn,))
            stream = self._streams[arn] = Stream(self.tables, number)
        return stream

    def since(self, name: str, position: int, limit: int, **scope: Any) -> list[Record]:
        """At most ``limit`` records from a position on, all of them committed."""
        return self.of(name, **scope).since(position, limit)

    # What ministack asks of its dictionary of records:

    def __contains__(self, name: str) -> bool:
        return True

    def __getitem__(self, name: str) -> Stream:
        return self.of(name)

    def get(self, name: str, _default: Any = None) -> Stream:
        """A table's stream."""
        return self.of(name)

    def pop(self, _name: str, default: Any = None) -> Any:
        """Nothing: `_dropping` deletes the records."""
        return default

    def clear(self) -> None:
        """Delete all streams."""
        with self.ledger.write() as connection:
            for table in ("streams", "records", "marks"):
                connection.execute(f"DELETE FROM {table}")  # noqa: S608 - our own names
        self._streams.clear()

    def position(self, mapping: str, arn: str) -> int | None:
        """The first record that the mapping had not finished; None for a new mapping."""
        rows = self.ledger.read("SELECT position FROM marks WHERE mapping = ? AND arn = ?", (mapping, arn))
        return int(rows[0][0]) if rows else None

    def mark(self, mapping: str, arn: str, position: int) -> None:
        """Note the first record that the mapping has not finished."""
        with self.ledger.write() as connection:
            connection.execute(
                "INSERT INTO marks VALUES (?, ?, ?) ON CONFLICT (mapping) DO UPDATE"
                " SET arn = excluded.arn, position = excluded.position",
                (mapping, arn, position),
            )

    def trim(self, now_s: float) -> None:
        """Delete records of more than 24 hours ago that every mapping has finished."""
        alive = {mapping["UUID"] for _, _, mapping in lambda_svc._iter_all_esms()}
        marks = self.ledger.read("SELECT mapping, arn, position FROM marks")
        with self.ledger.write() as connection:
            for mapping in {mapping for mapping, _, _ in marks} - alive:
                connection.execute("DELETE FROM marks WHERE mapping = ?", (mapping,))
        for (arn,) in self.ledger.read("SELECT arn FROM streams"):
            needed = [position for mapping, of, position in marks if mapping in alive and of == arn]
            finished = min(needed, default=_SPAN)
            gently(self.ledger, partial(self._stream(arn).trim, now_s - _RETENTION_S, finished))

    def _trimming(self, expire: Callable[[float], None]) -> Callable[[float], None]:
        @wraps(expire)
        def trimmed(now_s: float) -> None:
            self.trim(now_s)
            expire(now_s)

        return trimmed

    def _dropping(self, drop: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(drop)
        def dropped(name: str, table: dict[str, Any] | None = None) -> None:
            arn = (table or {}).get("LatestStreamArn") or name
            with self.ledger.write():
                drop(name, table)
                self._stream(arn).delete()
            del self._streams[arn]

        return dropped


class Stream(Sequence[Record]):
    """The records of one stream that are not trimmed, oldest first."""

    def __init__(self, tables: Tables, number: int) -> None:
        self._tables, self._ledger = tables, tables.ledger
        self._number, self._first = number, number * _SPAN
        self._end: int | None = None

    @property
    def start(self) -> int:
        """The position of the oldest record."""
        return self._edge("min") or 0

    @property
    def end(self) -> int:
        """The position after the newest record."""
        if self._end is None:
            newest = self._edge("max")
            self._end = 0 if newest is None else newest + 1
        return self._end

    def _edge(self, which: str) -> int | None:
        ((found,),) = self._ledger.read(
            f"SELECT {which}(id) FROM records WHERE id >= ? AND id < ?",  # noqa: S608 - min or max
            (self._first, self._first + _SPAN),
        )
        return None if found is None else int(found) - self._first

    def append(self, record: Record) -> None:
        """Add a record; its sequence number is its position."""
        change = record["dynamodb"]
        with self._ledger.write() as connection:
            position = self.end
            change["SequenceNumber"] = f"{position:021d}"
            new = change.get("NewImage")
            text = None if new is None else self._tables.encode(new)
            head = {**record, "dynamodb": {key: value for key, value in change.items() if key != "NewImage"}}
            connection.execute(
                "INSERT INTO records VALUES (?, ?, ?, ?)",
                (self._first + position, time.time(), json.dumps(head), text),
            )
        self._end = position + 1

    def since(self, position: int, limit: int) -> list[Record]:
        """At most ``limit`` records from a position on, all of them committed."""
        rows = self._ledger.read_committed(
            "SELECT record, new FROM records WHERE id >= ? AND id < ? ORDER BY id LIMIT ?",
            (self._first + position, self._first + _SPAN, limit),
        )
        return [_record(*row) for row in rows]

    def __len__(self) -> int:
        return self.end - self.start

    @overload
    def __getitem__(self, index: int) -> Record: ...
    @overload
    def __getitem__(self, index: slice) -> list[Record]: ...
    def __getitem__(self, index: int | slice) -> Record | list[Record]:
        wanted = range(len(self))[index]
        if isinstance(wanted, range):
            return [self[one] for one in wanted]
        (record,) = self.since(self.start + wanted, 1)
        return record

    def trim(self, before_s: float, finished: int) -> bool:
        """Delete some of the records that are older, up to a position; returns whether there may be more.

        The newest stays: its position is the count.
        """
        end = self._first + min(finished, self.end - 1)
        rows = self._ledger.read(
            "SELECT id, at_s FROM records WHERE id >= ? AND id < ? ORDER BY id LIMIT ?",
            (self._first, end, _TRIMMED_ROWS),
        )
        old = list(takewhile(lambda row: row[1] < before_s, rows))
        if old:
            with self._ledger.write() as connection:
                connection.execute("DELETE FROM records WHERE id >= ? AND id <= ?", (self._first, old[-1][0]))
        return len(old) == _TRIMMED_ROWS

    def delete(self) -> None:
        """Delete the stream."""
        with self._ledger.write() as connection:
            connection.execute(
                "DELETE FROM records WHERE id >= ? AND id < ?", (self._first, self._first + _SPAN)
            )
            connection.execute("DELETE FROM streams WHERE id = ?", (self._number,))


def position_of(record: Mapping[str, Any]) -> int:
    """A record's position in its stream."""
    return int(record["dynamodb"]["SequenceNumber"])


def _record(text: str, new: str | None) -> Record:
    record: Record = json.loads(text)
    if new is not None:
        record["dynamodb"]["NewImage"] = json.loads(new)
    return record
