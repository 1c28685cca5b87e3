"""Serialized messages as columns and back: one sample per message, and the exact bytes again.

A message of numbers only, after its header (`Decoder.flat`), is written as columns, which take half the bytes
of the compressed message; its header is stored beside them. The writer rebuilds the messages and compares
them. If any bit differs (a NaN's, a negative zero's), or the numbers do not become steps, the messages are
stored unchanged.
"""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from functools import lru_cache
from typing import Any, Mapping, NamedTuple, Sequence

from iort_contract.checks import COMPACT, shown, wire_column
from iort_contract.codec import packed, unpacked
from iort_contract.limits import (
    MAX_BATCH_VALUES,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    ContractError,
    MessageError,
    Value,
)
from iort_contract.ros.decode import HEADER, Decoder
from iort_contract.ros.definition import parse
from iort_contract.ros.message import MAX_LAYOUT, Messages

_NS = 1_000_000_000
# The limit for all frame_ids of a batch; messages with longer ones are stored unchanged.
_MAX_FRAMES = 256 * 1024
# Our batches hold at most this many values; in a batch of other software, the rest is not decoded.
_MAX_VIEWED = 2 * MAX_BATCH_VALUES


@lru_cache(maxsize=64)
def decoder_of(layout: str) -> Decoder:
    """The decoder of a layout: a type's name, a newline and its definition.

    Raises `MessageError` for an invalid layout.
    """
    kind, _, definition = layout.partition("\n")
    if len(layout) > MAX_LAYOUT:
        raise MessageError(f"layout must be at most {MAX_LAYOUT} characters, got {len(layout)}")
    return Decoder(parse(kind, definition))


def values_a_message(messages: Messages) -> int:
    """The estimated number of values per message, by the longest."""
    if not messages.layout:
        return 0
    try:
        return len(decoder_of(messages.layout).decode(max(messages.raw, key=len)))
    except MessageError:
        return 0


def view(messages: Messages) -> tuple[dict[str, list[Value]], int]:
    """The messages' samples as columns, with None for a missing field; and the number of values that are
    not finite."""
    if not messages.layout:
        return {}, 0
    decoder = decoder_of(messages.layout)
    numbers = _numbers(decoder, messages.raw)
    columns = _walked(decoder, messages.raw) if numbers is None else numbers.columns()
    viewed: dict[str, list[Value]] = {}
    nulled = 0
    for name, column in columns.items():
        # A query could not use a longer name.
        if len(name) <= MAX_FIELD_CHARACTERS:
            viewed[name], several = wire_column(name, column)
            nulled += several
    return viewed, nulled


def _walked(decoder: Decoder, raws: Sequence[bytes]) -> dict[str, list[Value]]:
    columns: dict[str, list[Value]] = {}
    count, walked = 0, decoder.walked
    for i, raw in enumerate(raws):
        values: Mapping[str, Value] = {}
        if max(count, decoder.walked - walked) < _MAX_VIEWED:
            with suppress(MessageError):
                values = decoder.decode(raw)
        count += len(values)
        for name, value in values.items():
            if name in columns or len(columns) < MAX_FIELDS:
                column = columns.setdefault(name, [])
                column.extend([None] * (i - len(column)))
                column.append(value)
    for column in columns.values():
        column.extend([None] * (len(raws) - len(column)))
    return columns


def as_columns(messages: Messages, times_us: Sequence[int]) -> tuple[dict[str, list[Value]], str] | None:
    """Messages as `packed` columns, and the rest needed to rebuild them, as JSON. None if the messages are
    better stored unchanged."""
    if not messages.layout:
        return None
    decoder = decoder_of(messages.layout)
    numbers = _numbers(decoder, messages.raw)
    if numbers is None or max(map(len, numbers.names)) > MAX_FIELD_CHARACTERS:
        return None
    columns: dict[str, list[Value]] = {}
    written: dict[str, list[Value]] = {}
    for name, column in numbers.columns().items():
        columns[name] = wire_column(name, column)[0]
        written[name] = packed(columns[name])
        # Numbers that are not steps take more as text than as bytes.
        if written[name][0] is None and float in set(map(type, columns[name])):
            return None
    if numbers.rows != _rows(numbers.struct, numbers.names, columns):
        return None
    about: list[Any] = [messages.type_id]
    if decoder.stamped:
        heads = [HEADER.unpack_from(raw) for raw in messages.raw]
        frames = [raw[HEADER.size : HEADER.size + head[3]] for raw, head in zip(messages.raw, heads)]
        try:
            texts = [frame.decode() for frame in frames]
        except UnicodeDecodeError:
            return None
        offsets = [sec * _NS + ns - 1000 * t_us for t_us, (_, sec, ns, _) in zip(times_us, heads)]
        if any(ns >= _NS for _, _, ns, _ in heads) or sum(map(len, frames)) > _MAX_FRAMES:
            return None
        seqs = [head[0] for head in heads]
        about.append(seqs[0] if seqs == list(range(seqs[0], seqs[0] + len(seqs))) else packed(seqs))
        about.append(_digits(offsets) or packed(offsets))
        about.append(texts if len(set(texts)) > 1 else texts[0])
    return written, COMPACT.encode(about)


def from_columns(
    columns: Mapping[str, Sequence[Value]], about: str, times_us: Sequence[int], layouts: Mapping[str, str]
) -> Messages:
    """Rebuild the messages of `as_columns`; ``layouts`` has the layout of each type by its id.

    Raises `ContractError` for an unknown type, or columns of another type.
    """
    n = len(times_us)
    try:
        name, *head = json.loads(about)
        if not isinstance(name, str) or name not in layouts:
            raise ContractError(f"the messages' type {shown(name)} is unknown")
        decoder = decoder_of(layouts[name])
        if decoder.flat is None:
            raise ContractError(f"type {name} must consist of numbers")
        rows, size = _rows(*decoder.flat, columns), decoder.flat[0].size
        if len(rows) != n * size:
            raise ContractError(f"the columns do not fit the type {name}")
        raw = [rows[i * size : (i + 1) * size] for i in range(n)]
        if decoder.stamped:
            seq, stamp, frame = head
            seqs = range(seq, seq + n) if type(seq) is int else unpacked("seq", seq, n)
            offsets: Sequence[Any] = (
                [int(stamp[3 * i : 3 * i + 3]) for i in range(n)]
                if isinstance(stamp, str)
                else unpacked("stamp", stamp, n)
            )
            # A single value stands for all messages.
            texts = [frame] * n if isinstance(frame, str) else frame
            if not isinstance(texts, list) or len(texts) != n or sum(map(len, texts)) > _MAX_FRAMES:
                raise ContractError(f"frame_id must be {n} texts of at most {_MAX_FRAMES} characters")
            heads = map(_head, seqs, times_us, offsets, texts)
            raw = [start + body for start, body in zip(heads, raw)]
    except (AttributeError, RecursionError, TypeError, ValueError, struct.error) as error:
        if isinstance(error, ContractError):
            raise
        raise ContractError(f"the messages cannot be rebuilt: {error}") from error
    return Messages(name, layouts[name], raw)


def _head(seq: Any, t_us: int, offset_ns: Any, frame: str) -> bytes:
    sec, nanosec = divmod(t_us * 1000 + offset_ns, _NS)
    text = str.encode(frame)
    return HEADER.pack(seq, sec, nanosec, len(text)) + text


def _digits(offsets: Sequence[int]) -> str:
    """Offsets within a microsecond as three digits each, the most compact form; empty for others."""
    if min(offsets) < 0 or max(offsets) > 999:
        return ""
    return "".join(map("{:03d}".format, offsets))


class _Numbers(NamedTuple):
    """Messages of numbers only, without their headers: one struct for each, and the names of its numbers."""

    struct: struct.Struct
    names: Sequence[str]
    rows: bytes

    def columns(self) -> dict[str, list[Value]]:
        """The numbers by name."""
        return dict(zip(self.names, map(list, zip(*self.struct.iter_unpack(self.rows)))))


def _numbers(decoder: Decoder, raws: Sequence[bytes]) -> _Numbers | None:
    """The messages' numbers; None if there is anything else, or if a message has another length."""
    if decoder.flat is None:
        return None
    reader, names = decoder.flat
    try:
        starts = [HEADER.size + HEADER.unpack_from(raw)[3] if decoder.stamped else 0 for raw in raws]
    except struct.error:
        return None
    bodies = [raw[start:] for raw, start in zip(raws, starts)]
    return _Numbers(reader, names, b"".join(bodies)) if set(map(len, bodies)) == {reader.size} else None


def _rows(writer: struct.Struct, names: Sequence[str], columns: Mapping[str, Sequence[Value]]) -> bytes:
    """The messages without their headers, joined; empty if a value does not fit."""
    if columns.keys() != set(names):
        return b""
    try:
        return b"".join([writer.pack(*row) for row in zip(*(columns[name] for name in names))])
    except (struct.error, OverflowError):
        return b""
