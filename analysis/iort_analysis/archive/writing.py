"""Writes an hour's items as a Parquet file, and joins a day's hours to one file."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from iort_analysis.archive import columns as names
from iort_analysis.archive.columns import (
    MIXED,
    NOTHING,
    OWN,
    TYPES,
    VARIED,
    cast,
    column_name,
    joined_kind,
    named,
    to_values,
)
from iort_analysis.archive.pieces import pieces
from iort_analysis.archive.reading import HOURS, KINDS, ArchiveFile
from iort_contract.archive import Hour, content_hash, item_hash
from iort_contract.catalog.streams import CATALOG
from iort_contract.dynamodb import Item, whole
from iort_contract.tables import BATCH, EXPIRES_S

# Gives a field's unit and its meaning, each perhaps empty.
Describe = Callable[[str], tuple[str, str]]
_LEVEL = 6


class Written(NamedTuple):
    """What a file got. ``content`` is the contract's `content_hash` of all items. ``refused`` counts the
    items that are not in the file, by the reason. ``first_expires_s`` is 0 if no item expires."""

    batches: int
    samples: int
    refused: Mapping[str, int]
    content: str
    first_expires_s: int


def described(stream: str) -> Describe:
    """What the catalogue knows of a stream's fields."""
    known = CATALOG[stream].fields if stream in CATALOG else ()
    fields = {field.name: (field.unit, field.meaning) for field in known}
    return lambda name: fields.get(name, ("", ""))


def write_hour(
    items: Iterable[Item],
    into: IO[bytes],
    *,
    hour: Hour,
    refused: IO[bytes],
    scratch: IO[bytes],
    describe: Describe = lambda _field: ("", ""),
) -> Written:
    """Write the batches of an hour, in the order of their ids.

    Items that are no batches are written to ``refused``, as DynamoDB's JSON, a line each. ``scratch`` is a
    file for reading and writing. Nothing is written ``into`` if there is no batch.
    """
    hashes: list[tuple[str, str]] = []
    reasons: Counter[str] = Counter()
    expiries: list[int] = []

    def each() -> Iterator[Item]:
        for item in items:
            hashes.append((item[BATCH]["S"], item_hash(item)))
            if (expires_s := whole(item, EXPIRES_S)) is not None:
                expiries.append(expires_s)
            yield item

    def refuse(item: Item, reason: str) -> None:
        reasons[reason] += 1
        refused.write(json.dumps(item, separators=(",", ":"), default=_base64).encode() + b"\n")

    batches = samples = 0
    kinds: dict[str, str] = {}
    places: list[Mapping[str, str]] = []
    for piece in pieces(each(), refuse):
        batches += piece.batches
        samples += len(piece.table)
        kinds.update(
            {name: joined_kind(kind, kinds.get(name, NOTHING)) for name, kind in piece.kinds.items()}
        )
        places.append(piece.kinds)
        with pa.ipc.new_stream(scratch, piece.table.schema) as stream:
            stream.write_table(piece.table)
    if places:
        scratch.seek(0)
        tables = ((_read(scratch), local) for local in places)
        _write(into, kinds, tables, {str(hour): (0, len(places))}, describe)
    ordered = content_hash(sorted(hashes))
    return Written(batches, samples, dict(reasons), ordered, min(expiries, default=0))


def _base64(content: bytes) -> str:
    """Bytes as DynamoDB's JSON has them."""
    return base64.b64encode(content).decode()


def write_day(hours: Mapping[Hour, ArchiveFile], into: IO[bytes], *, describe: Describe) -> None:
    """Join files to one with the row groups of these hours, each from the file that is given for it."""
    kinds: dict[str, str] = {}
    places: dict[str, tuple[int, int]] = {}
    found: list[tuple[ArchiveFile, int]] = []
    for hour, file in sorted(hours.items()):
        groups = file.groups(hour)
        places[str(hour)] = (len(found), len(groups))
        found += [(file, group) for group in groups]
        kinds.update({name: joined_kind(kind, kinds.get(name, NOTHING)) for name, kind in file.kinds.items()})
    _write(into, kinds, ((file.table(group), file.kinds) for file, group in found), places, describe)


def _write(
    into: IO[bytes],
    kinds: Mapping[str, str],
    tables: Iterable[tuple[Any, Mapping[str, str]]],
    places: Mapping[str, tuple[int, int]],
    describe: Describe,
) -> None:
    """Write each table, whose fields have these kinds, as a row group."""
    of_columns = dict(list(kinds.items())[: names.MAX_COLUMNS])
    schema = _schema(of_columns, places, describe)
    varied = [column_name(name) for name, kind in of_columns.items() if kind == VARIED]
    # Of a number with many values the bytes of one place are similar; of regular times, the steps.
    encodings = {**dict.fromkeys(varied, "BYTE_STREAM_SPLIT"), names.TIME: "DELTA_BINARY_PACKED"}
    with pq.ParquetWriter(
        into,
        schema,
        compression="zstd",
        compression_level=_LEVEL,
        column_encoding=encodings,
        use_dictionary=[name for name in schema.names if name not in {*encodings, names.MESSAGE}],
    ) as writer:
        for table, local in tables:
            arrays = {name: table[name] for name in OWN}
            arrays[names.OTHER] = _with_others(
                table, {name: kind for name, kind in local.items() if name not in of_columns}
            )
            for name, kind in of_columns.items():
                array = pa.nulls(len(table), TYPES[kind])
                if name in local:
                    array = cast(table[named(name)], local[name], kind)
                arrays[column_name(name)] = array
            rows = pa.table([arrays[name] for name in schema.names], schema=schema)
            writer.write_table(rows, row_group_size=max(1, len(rows)))


def _read(scratch: IO[bytes]) -> Any:
    return pa.ipc.open_stream(scratch).read_all().combine_chunks().to_batches()[0]


def _schema(kinds: Mapping[str, str], places: Mapping[str, tuple[int, int]], describe: Describe) -> Any:
    """The times, the fields, then what belongs to batches and messages."""
    fields = []
    for name, kind in kinds.items():
        unit, meaning = describe(name)
        metadata = {names.FIELD: name.encode(), names.UNIT: unit.encode(), names.MEANING: meaning.encode()}
        if kind == MIXED:
            metadata[names.ENCODING] = names.JSON
        fields.append(
            pa.field(column_name(name), TYPES[kind], metadata={k: v for k, v in metadata.items() if v})
        )
    time, *own = (pa.field(name, kind) for name, kind in OWN.items())
    return pa.schema([time, *fields, *own], metadata={HOURS: json.dumps(places), KINDS: json.dumps(kinds)})


def _with_others(table: Any, more: Mapping[str, str]) -> Any:
    """The column of fields without a column, with more such fields of these kinds."""
    others = table[names.OTHER]
    if not more:
        return others
    rows = [json.loads(text or "{}") for text in others.to_pylist()]
    for name, kind in more.items():
        for row, value in zip(rows, to_values(table[named(name)], is_json=kind == MIXED), strict=True):
            if value is not None:
                row[name] = value
    return pa.array([json.dumps(row) if row else None for row in rows], type=OWN[names.OTHER])
