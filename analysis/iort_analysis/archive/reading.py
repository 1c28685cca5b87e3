"""Reads the archive's files: samples as blocks, batches without their samples, and the stored items again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from iort_analysis.archive import columns as names
from iort_analysis.archive.columns import MIXED, column_name, named, runs, to_numpy, to_values
from iort_analysis.samples.batches import Part, Wanted
from iort_analysis.samples.blocks import Block, Column, column_of
from iort_contract.archive import Hour
from iort_contract.codec import CODEC, packed_samples
from iort_contract.dynamodb import ALL, Item, Keys
from iort_contract.limits import BATCH_VERSION, Value
from iort_contract.messages.batch import batch_id
from iort_contract.ros.message import Messages, pack
from iort_contract.tables import BATCH, NONFINITE, PREVIOUS, RECEIVED_MS, SAMPLES, TOPIC

# In the file's metadata: the first row group and the number of them by hour, and the fields' kinds.
HOURS, KINDS = b"iort:hours", b"iort:kinds"
_HEAD = (names.BATCH_ID, names.RECEIVED, names.NOT_FINITE, names.PREVIOUS_RUNS, names.HASH)


class ArchiveFile:
    """A file of the archive: an hour of a stream, or a day's hours.

    ``source`` is the file's bytes, or a file that can seek; only what is asked for is read from it. ``hour``
    chooses one in the methods that take it; None is all.
    """

    def __init__(self, source: bytes | IO[bytes]) -> None:
        self._file = pq.ParquetFile(pa.BufferReader(source) if isinstance(source, bytes) else source)
        metadata = self._file.schema_arrow.metadata
        self._hours: dict[str, list[int]] = json.loads(metadata[HOURS])
        self.kinds: dict[str, str] = json.loads(metadata[KINDS])

    @property
    def hours(self) -> Sequence[str]:
        """The hours in the file."""
        return list(self._hours)

    @property
    def rows(self) -> int:
        """The samples in the file."""
        return int(self._file.metadata.num_rows)

    def groups(self, hour: Hour | None = None, keys: Keys = ALL) -> list[int]:
        """The row groups of an hour that may have batches with these keys."""
        first, count = (0, self._file.num_row_groups) if hour is None else self._hours.get(str(hour), (0, 0))
        return [group for group in range(first, first + count) if self._overlaps(group, keys)]

    def pages(
        self,
        hour: Hour | None = None,
        wanted: Wanted = lambda _name: True,
        *,
        keys: Keys = ALL,
        messages: bool = True,
    ) -> Iterator[Part]:
        """The samples of the batches with these keys and the fields that are ``wanted``, in the order of the
        batches; `in_order` brings them into the order of time. Without ``messages``, batches of ROS messages
        are left out.
        """
        for group in self.groups(hour, keys):
            if part := self._part(group, wanted, keys, messages=messages):
                yield part

    def span(self, hour: Hour) -> tuple[int, int]:
        """Where an hour's bytes are in the file, from the first one to behind the last."""
        columns = [
            self._file.metadata.row_group(group).column(i)
            for group in self.groups(hour)
            for i in range(self._file.metadata.num_columns)
        ]
        starts = [one.dictionary_page_offset or one.data_page_offset for one in columns]
        ends = [start + one.total_compressed_size for start, one in zip(starts, columns, strict=True)]
        return min(starts), max(ends)

    def has_messages(self, hour: Hour | None = None) -> bool:
        """Whether batches hold ROS messages as they were published."""
        return any(
            self._read(group, (names.LAYOUT,))[names.LAYOUT].null_count
            < self._file.metadata.row_group(group).num_rows
            for group in self.groups(hour)
        )

    def headers(self, hour: Hour | None = None) -> Iterator[Item]:
        """The batches as stored items without their samples: id, count of samples, and what else is small."""
        for group in self.groups(hour):
            table = self._read(group, _HEAD)
            ids, rows = runs(table[names.BATCH_ID])
            head = table.take(pa.array(rows[:-1]))
            for i, n in enumerate(np.diff(rows).tolist()):
                yield {BATCH: {"S": ids[i]}, SAMPLES: {"N": str(n)}, **head_of(head, i)}

    def hashes(self, hour: Hour | None = None) -> Iterator[tuple[str, str]]:
        """The ids of the batches, and the hashes of their items."""
        for group in self.groups(hour):
            table = self._read(group, (names.BATCH_ID, names.HASH))
            ids, rows = runs(table[names.BATCH_ID])
            yield from zip(ids, table[names.HASH].take(pa.array(rows[:-1])).to_pylist(), strict=True)

    def table(self, group: int) -> Any:
        """A row group as a table like a piece's."""
        table = self._read(group, self._file.schema_arrow.names)
        fields = {column_name(name): named(name) for name in self.kinds}
        return table.rename_columns([fields.get(name, name) for name in table.column_names])

    def _part(self, group: int, wanted: Wanted, keys: Keys, *, messages: bool) -> Part | None:
        chosen = {name: column_name(name) for name in self.kinds if wanted(name)}
        own = (names.TIME, names.BATCH_ID, names.FIELDS, names.ABOUT, names.LAYOUT, names.OTHER)
        table = self._read(group, (*own, *chosen.values()))
        ids, rows = runs(table[names.BATCH_ID])
        kept = [keys.first["S"] <= each <= keys.last["S"] for each in ids]
        if not messages:
            heads = table.select([names.ABOUT, names.LAYOUT]).take(pa.array(rows[:-1])).to_pylist()
            kept = [keep and set(head.values()) == {None} for keep, head in zip(kept, heads, strict=True)]
        if not any(kept):
            return None
        if not all(kept):
            table = table.filter(pa.array(np.repeat(kept, np.diff(rows))))
        times = table[names.TIME].cast(pa.int64()).to_numpy()
        # In the order in which the batches name them, as in their own decoding.
        of_batches = runs(table[names.FIELDS])[0]
        present = dict.fromkeys(name for text in of_batches for name in text.replace("|", ",").split(","))
        columns = {
            name: to_numpy(table[chosen[name]], is_json=self.kinds[name] == MIXED)
            if name in chosen
            else others(table[names.OTHER], name)
            for name in present
            if name and wanted(name)
        }
        last = next(each for each, keep in zip(reversed(ids), reversed(kept), strict=True) if keep)
        return Part(Block(times, columns), batch_id(last).t_us)

    def _overlaps(self, group: int, keys: Keys) -> bool:
        if keys is ALL:
            return True
        low, high = self._spans[group]
        # A key begins with the time of its batch's first sample.
        return low <= int(keys.last["S"][:16]) and high >= int(keys.first["S"][:16])

    @cached_property
    def _spans(self) -> list[tuple[int, int]]:
        """The first and the last time of each row group."""
        spans = []
        for group in range(self._file.num_row_groups):
            statistics = self._file.metadata.row_group(group).column(0).statistics
            spans.append(
                tuple(
                    pa.scalar(t, pa.timestamp("us", tz="UTC")).value for t in (statistics.min, statistics.max)
                )
            )
        return spans

    def _read(self, group: int, columns: Sequence[str]) -> Any:
        table = self._file.read_row_group(group, columns=list(columns), use_threads=False)
        # Parquet takes a name with dots for a path, and reads what else begins like it.
        return table.select(list(columns)).combine_chunks().to_batches()[0]


def others(texts: Any, name: str) -> Column:
    """A field that has no column."""
    return column_of([json.loads(text or "{}").get(name) for text in texts.to_pylist()])


def head_of(table: Any, row: int) -> Item:
    """What a stored item says beside its samples, from a row of a table."""
    received, nonfinite, previous, digest = (table[name][row].as_py() for name in _HEAD[1:])
    item: Item = {"_sha256": {"S": digest}}
    if received is not None:
        item[RECEIVED_MS] = {"N": str(received)}
    if nonfinite is not None:
        item[NONFINITE] = {"N": str(nonfinite)}
    if previous is not None:
        item[PREVIOUS] = {"S": previous}
    return item


# The way back from the archive's files to stored items: slow, and for whoever needs whole batches.

# Most of them are inflated again at once.
_LEVEL = 1


def items(file: ArchiveFile, topic: str, hour: Hour | None = None, keys: Keys = ALL) -> Iterator[Item]:
    """The batches of a file with these keys as stored items; only their row groups are read.

    They decode to the same batches and ROS messages as the stored ones, but may be compressed in another way;
    each has the hash of the stored one as the contract's `HASH`.
    """
    for group in file.groups(hour, keys):
        table = file.table(group)
        ids, rows = runs(table[names.BATCH_ID])
        columns = _Columns(file.kinds, table)
        for i, batch in enumerate(ids):
            if not keys.first["S"] <= batch <= keys.last["S"]:
                continue
            start, end = int(rows[i]), int(rows[i + 1])
            codec, samples = columns.samples(start, end)
            yield {
                TOPIC: {"S": topic},
                BATCH: {"S": batch},
                "v": {"N": str(BATCH_VERSION)},
                SAMPLES: {"N": str(end - start)},
                "codec": {"S": codec},
                "samples": {"S": samples},
                **head_of(table, start),
            }


class _Columns:
    """A table's fields as values of the wire."""

    def __init__(self, kinds: Mapping[str, str], table: Any) -> None:
        self._kinds, self._table = kinds, table
        self._times = table[names.TIME].cast("int64").to_numpy()

    def samples(self, start: int, end: int) -> tuple[str, str]:
        """The codec and the samples of the batch in these rows."""
        beside = str(self._table[names.FIELDS][start].as_py()).rpartition("|")[2]
        dt = [0, *np.diff(self._times[start:end]).tolist()]
        layout = self._table[names.LAYOUT][start].as_py()
        fields = {name: self._values(name, start, end) for name in beside.split(",") if name}
        if layout is None:
            about = self._table[names.ABOUT][start].as_py() or ""
            return CODEC, packed_samples(dt, fields, about.encode(), level=_LEVEL)
        kind = self._table[names.TYPE][start].as_py()
        raw = self._table[names.MESSAGE].slice(start, end - start).to_pylist()
        messages = Messages(kind, layout, raw)
        return messages.codec, packed_samples(dt, fields, pack(messages), messages.codec, level=_LEVEL)

    def _values(self, name: str, start: int, end: int) -> Sequence[Value]:
        if name not in self._kinds:
            others = self._table[names.OTHER].slice(start, end - start).to_pylist()
            return [json.loads(text or "{}").get(name) for text in others]
        array = self._table[named(name)].slice(start, end - start)
        return to_values(array, is_json=self._kinds[name] == MIXED)
