"""Writes an hour's items as a Parquet file, and joins a day's hours to one file."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from io import SEEK_END
from itertools import groupby, islice
from typing import IO, Any, NamedTuple

import numpy as np
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
    kind_of,
    named,
    repeated,
    to_arrow,
    to_values,
)
from iort_analysis.archive.reading import HOURS, KINDS, ArchiveFile
from iort_analysis.samples.batches import Steps, decode_steps, steps_of
from iort_analysis.samples.blocks import Block, Column, exact, join
from iort_contract.archive import Hour, content_hash, item_hash
from iort_contract.catalog.streams import CATALOG
from iort_contract.checks import integer
from iort_contract.codec import packed_samples, unpacked
from iort_contract.dynamodb import Item, plain, whole
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Envelope, open_envelope, read_envelope
from iort_contract.ros.columns import view
from iort_contract.ros.message import Messages, unpack
from iort_contract.tables import BATCH, EXPIRES_S, NONFINITE, PREVIOUS, RECEIVED_MS

# Stored items in pieces: some thousand batches decoded to a table each, and what is refused.

# A piece becomes a row group; it ends when one of these is reached.
_ROWS, _VALUES, _BYTES = 262_144, 8_000_000, 32 * 1024 * 1024
# Batches that are decoded together: their lists of Python numbers take ten times the memory of the arrays.
_TOGETHER = 100
# A batch with more text may not fit into a batch again once its text is escaped.
_MUCH_TEXT = 400_000
Refuse = Callable[[Item, str], None]


class Piece(NamedTuple):
    """Batches as a table with the columns `OWN` and a column a field, and each field's kind."""

    table: Any
    kinds: Mapping[str, str]
    batches: int


class Head(NamedTuple):
    """What a batch says beside its samples. ``fields`` has the names of its columns as the file has them:
    `field_list`. ROS messages have their type's id and its layout."""

    id: str
    n: int
    received_ms: int | None
    nonfinite: int | None
    previous: str | None
    hash: str
    fields: str
    about: str | None = None
    type_id: str | None = None
    layout: str | None = None


class _Entry(NamedTuple):
    """A valid item: what its batch says beside the samples, and the names of its columns; and its ROS
    messages, if it has them as published, with the fields in them."""

    item: Item
    envelope: Envelope
    about: str
    names: Sequence[str]
    messages: Messages | None = None
    viewed: Sequence[str] = ()


def pieces(items: Iterable[Item], refuse: Refuse) -> Iterator[Piece]:
    """The items' batches in pieces, in the order of the items. Items that are no batches go to ``refuse``."""
    parts: list[tuple[list[_Entry], Block]] = []
    rows = values = size = 0
    for part in _decoded(items, refuse):
        rows += len(part[1].times_us)
        values += len(part[1].times_us) * len(part[1].columns)
        size += sum(len(raw) for one in part[0] if one.messages for raw in one.messages.raw)
        size += sum(map(_text, part[1].columns.values()))
        parts.append(part)
        if rows >= _ROWS or values >= _VALUES or size >= _BYTES:
            yield _piece(parts)
            parts, rows, values, size = [], 0, 0, 0
    if any(entries for entries, _ in parts):
        yield _piece(parts)


def _text(column: Column) -> int:
    return sum(len(value) for value in column if type(value) is str) if column.dtype.kind == "O" else 0


def _decoded(items: Iterable[Item], refuse: Refuse) -> Iterator[tuple[list[_Entry], Block]]:
    """The valid items some at a time, with all their samples."""
    for _, same in groupby(_envelopes(items, refuse), key=lambda one: one[2] and one[2].names):
        while run := list(islice(same, _TOGETHER)):
            steps = [own for _, _, own in run if own is not None]
            block = decode_steps(steps, lambda _name: True) if len(steps) == len(run) else None
            if block is not None:
                fields = list(block.columns)
                yield [_Entry(item, _head(one), one.about, fields) for item, one, _ in run], block
                continue
            entries, blocks = [], []
            for item, envelope, _ in run:
                try:
                    entry, own = _alone(item, envelope)
                except ContractError as error:  # noqa: PERF203 - each is refused by itself
                    refuse(item, str(error))
                else:
                    entries.append(entry)
                    blocks.append(own)
            yield entries, join(blocks)


def _envelopes(items: Iterable[Item], refuse: Refuse) -> Iterator[tuple[Item, Envelope, Steps | None]]:
    for item in items:
        try:
            envelope = read_envelope(plain(item))
        except ContractError as error:  # noqa: PERF203 - each is refused by itself
            refuse(item, str(error))
        else:
            yield item, envelope, steps_of(envelope) if len(envelope.behind) <= _MUCH_TEXT else None


def _head(envelope: Envelope) -> Envelope:
    """The envelope without its samples, which would stay in memory for the whole piece."""
    return envelope._replace(text=b"", behind=b"")


def _alone(item: Item, envelope: Envelope) -> tuple[_Entry, Block]:
    """A batch in any form; raises `ContractError`."""
    times, columns = open_envelope(envelope)
    n, about = len(times), envelope.about
    beside = {name: unpacked(name, column, n) for name, column in columns.items()}
    texts = sum(len(value) for column in beside.values() for value in column if type(value) is str)
    if texts + len(about) > _MUCH_TEXT:
        packed_samples([0] * n, beside, about.encode())
    messages = unpack(envelope.behind, n) if envelope.serialized else None
    viewed = {} if messages is None else view(messages)[0]
    entry = _Entry(item, _head(envelope), about, list(beside), messages, list(viewed))
    samples = {name: exact(values) for name, values in {**viewed, **beside}.items()}
    return entry, Block(np.array(times, dtype=np.int64), samples)


def _piece(parts: list[tuple[list[_Entry], Block]]) -> Piece:
    entries = [one for part, _ in parts for one in part]
    messages = [
        raw for one in entries for raw in (one.messages.raw if one.messages else [None] * one.envelope.n)
    ]
    return piece([_head_of(one) for one in entries], join([part for _, part in parts]), messages)


def _head_of(one: _Entry) -> Head:
    viewed = None if one.messages is None else one.viewed
    return Head(
        str(one.envelope.id),
        one.envelope.n,
        _received_ms(one.item),
        one.envelope.nonfinite if NONFINITE in one.item else None,
        one.item[PREVIOUS]["S"] if PREVIOUS in one.item else None,
        item_hash(one.item),
        field_list(one.names, viewed),
        one.about or None,
        one.messages.type_id if one.messages else None,
        one.messages.layout if one.messages else None,
    )


def field_list(names: Sequence[str], viewed: Sequence[str] | None) -> str:
    """A batch's fields, as the file names them; ``viewed`` are those in its ROS messages."""
    own = ",".join(names)
    return own if viewed is None else f"{','.join(viewed)}|{own}"


def piece(heads: Sequence[Head], block: Block, messages: Sequence[bytes | None]) -> Piece:
    """Batches as a piece: their samples one after the other, and for each its ROS message as published."""
    counts = np.array([one.n for one in heads])
    own = {
        names.TIME: pa.array(block.times_us, type=OWN[names.TIME]),
        names.MESSAGE: pa.array(messages, type=OWN[names.MESSAGE]),
        names.OTHER: pa.nulls(len(block.times_us), OWN[names.OTHER]),
    }
    of_batches: dict[str, list[Any]] = {
        names.BATCH_ID: [one.id for one in heads],
        names.RECEIVED: [one.received_ms for one in heads],
        names.NOT_FINITE: [one.nonfinite for one in heads],
        names.PREVIOUS_RUNS: [one.previous for one in heads],
        names.HASH: [one.hash for one in heads],
        names.FIELDS: [one.fields for one in heads],
        names.ABOUT: [one.about for one in heads],
        names.TYPE: [one.type_id for one in heads],
        names.LAYOUT: [one.layout for one in heads],
    }
    own.update({name: repeated(values, counts, OWN[name]) for name, values in of_batches.items()})
    kinds = {name: kind_of(column) for name, column in block.columns.items()}
    own.update({named(name): to_arrow(column, kinds[name]) for name, column in block.columns.items()})
    return Piece(pa.table(own), kinds, len(heads))


def _received_ms(item: Item) -> int | None:
    """When the cloud received it; None for an item that somebody put into the table by hand."""
    with suppress(ContractError):
        return integer(plain({RECEIVED_MS: item.get(RECEIVED_MS, {"NULL": True})}), RECEIVED_MS)
    return None


# Gives a field's unit and its meaning, each perhaps empty.
Describe = Callable[[str], tuple[str, str]]
LEVEL = 6


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
    spool = Spool(scratch)
    for one in pieces(each(), refuse):
        batches += one.batches
        samples += len(one.table)
        spool.add(one)
    if batches:
        write_pieces(spool.pieces(), into, hour, describe)
    ordered = content_hash(sorted(hashes))
    return Written(batches, samples, dict(reasons), ordered, min(expiries, default=0))


class Spool:
    """Pieces in a file, until all of them are there: a file of the archive has one schema. Several spools may
    share the file."""

    def __init__(self, scratch: IO[bytes]) -> None:
        self._scratch = scratch
        self._pieces: list[tuple[Mapping[str, str], int, int]] = []

    def add(self, one: Piece) -> None:
        """Write a piece."""
        at = self._scratch.seek(0, SEEK_END)
        self._pieces.append((one.kinds, one.batches, at))
        with pa.ipc.new_stream(self._scratch, one.table.schema) as stream:
            stream.write_table(one.table)

    def pieces(self) -> Pieces:
        """The pieces, to be read once."""
        return Pieces(self._read(), len(self._pieces), joined_kinds(kinds for kinds, *_ in self._pieces))

    def _read(self) -> Iterator[Piece]:
        for kinds, batches, at in self._pieces:
            self._scratch.seek(at)
            # Each piece is one batch of Arrow's.
            table = pa.ipc.open_stream(self._scratch).read_all().combine_chunks()
            yield Piece(table.to_batches()[0], kinds, batches)


def joined_kinds(several: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """The kinds that hold the values of all."""
    kinds: dict[str, str] = {}
    for some in several:
        kinds.update({name: joined_kind(kind, kinds.get(name, NOTHING)) for name, kind in some.items()})
    return kinds


class Pieces(NamedTuple):
    """So many pieces, and the kinds of the fields of all of them."""

    pieces: Iterable[Piece]
    number: int
    kinds: Mapping[str, str]


def write_pieces(
    some: Pieces, into: IO[bytes], hour: Hour, describe: Describe, *, level: int = LEVEL
) -> None:
    """Write an hour's pieces, in the order of their batches, each as a row group."""
    tables = ((one.table, one.kinds) for one in some.pieces)
    _write(
        into, _schema(some.kinds, {str(hour): (0, some.number)}, describe), some.kinds, tables, level=level
    )


def in_order(pieces: Sequence[Piece]) -> Piece:
    """Pieces whose batches lie among each other as one, in the order of the batches' ids."""
    kinds = joined_kinds(one.kinds for one in pieces)
    tables = [pa.table(_cast_all(one, kinds)) for one in pieces]
    whole = pa.concat_tables(tables, promote_options="permissive").combine_chunks()
    ids = np.array(whole[names.BATCH_ID].to_pylist(), dtype=object)
    whole = whole.take(pa.array(np.argsort(ids, kind="stable"))).combine_chunks().unify_dictionaries()
    return Piece(whole.combine_chunks().to_batches()[0], kinds, sum(one.batches for one in pieces))


def _cast_all(one: Piece, kinds: Mapping[str, str]) -> dict[str, Any]:
    own = {name: one.table[name] for name in OWN}
    for name, kind in kinds.items():
        has = name in one.kinds
        nothing = pa.nulls(len(one.table), TYPES[kind])
        own[named(name)] = cast(one.table[named(name)], one.kinds[name], kind) if has else nothing
    return own


def _base64(content: bytes) -> str:
    """Bytes as DynamoDB's JSON has them."""
    return base64.b64encode(content).decode()


def write_day(hours: Mapping[Hour, ArchiveFile], into: IO[bytes], *, describe: Describe) -> None:
    """Join files to one with the row groups of these hours, each from the file that is given for it."""
    places: dict[str, tuple[int, int]] = {}
    found: list[tuple[ArchiveFile, int]] = []
    for hour, file in sorted(hours.items()):
        groups = file.groups(hour)
        places[str(hour)] = (len(found), len(groups))
        found += [(file, group) for group in groups]
    kinds = joined_kinds(file.kinds for _, file in sorted(hours.items()))
    tables = ((file.table(group), file.kinds) for file, group in found)
    _write(into, _schema(kinds, places, describe), kinds, tables, level=LEVEL)


def _write(
    into: IO[bytes],
    schema: Any,
    kinds: Mapping[str, str],
    tables: Iterable[tuple[Any, Mapping[str, str]]],
    *,
    level: int,
) -> None:
    """Write each table, whose fields have these kinds, as a row group."""
    of_columns = _columns(kinds)
    varied = [column_name(name) for name, kind in of_columns.items() if kind == VARIED]
    # Of a number with many values the bytes of one place are similar; of regular times, the steps.
    encodings = {**dict.fromkeys(varied, "BYTE_STREAM_SPLIT"), names.TIME: "DELTA_BINARY_PACKED"}
    with pq.ParquetWriter(
        into,
        schema,
        compression="zstd",
        compression_level=level,
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


def _columns(kinds: Mapping[str, str]) -> dict[str, str]:
    """The fields that have a column."""
    return dict(list(kinds.items())[: names.MAX_COLUMNS])


def _schema(every: Mapping[str, str], places: Mapping[str, tuple[int, int]], describe: Describe) -> Any:
    """The times, the fields, then what belongs to batches and messages."""
    fields, kinds = [], _columns(every)
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
