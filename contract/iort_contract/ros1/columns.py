"""Serialized messages as columns and back: a sample a message for whoever asks, and the exact bytes again.

A message that is nothing but numbers behind its header (`Decoder.flat`) is written as columns, which take
half the bytes of the message compressed, and what its header says stands beside them. Whoever writes them
makes the messages again and compares; where one differs in a bit (a NaN's, a negative zero's), or where
the numbers do not become steps, the messages are kept as they are.
"""

from __future__ import annotations

import json
import struct
from functools import lru_cache
from typing import Any, Iterable, Mapping, Sequence

from iort_contract.checks import COMPACT, shown, wire_column
from iort_contract.codec.columns import CODEC, packed, unpacked
from iort_contract.limits import (
    MAX_BATCH_VALUES,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    ContractError,
    MessageError,
    Value,
)
from iort_contract.ros1.decode import HEADER, Decoder
from iort_contract.ros1.definition import parse
from iort_contract.ros1.message import MAX_LAYOUT, Messages

_NS = 1_000_000_000
# Of all frame_ids of a batch; messages of longer ones are kept as they are.
_MAX_FRAMES = 256 * 1024
# A batch of ours holds no more values; of what another packs, the rest is not looked into.
_MAX_VIEWED = 2 * MAX_BATCH_VALUES


@lru_cache(maxsize=64)
def decoder_of(layout: str) -> Decoder:
    """The decoder of a layout, which is a type's name, a line's end and its definition.

    Raises `MessageError` for what is none.
    """
    kind, _, definition = layout.partition("\n")
    if len(layout) > MAX_LAYOUT:
        raise MessageError(f"a layout of {len(layout)} characters: allowed is up to {MAX_LAYOUT}")
    return Decoder(parse(kind, definition))


def values_a_message(messages: Messages) -> int:
    """About how many values a message has, judged by the longest."""
    if not messages.layout:
        return 0
    try:
        return len(decoder_of(messages.layout).decode(max(messages.raw, key=len))[0])
    except MessageError:
        return 0


def view(messages: Messages) -> tuple[dict[str, list[Value]], int]:
    """The samples of messages as columns, None where one lacks a field; how many values were not finite."""
    columns: dict[str, list[Value]] = {}
    if not messages.layout:
        return {}, 0
    decoder = decoder_of(messages.layout)
    bodies = _bodies(decoder, messages.raw)
    if decoder.flat is not None and bodies is not None:
        columns = _columns(decoder, bodies)
    else:
        viewed, walked = 0, decoder.walked
        for i, raw in enumerate(messages.raw):
            enough = max(viewed, decoder.walked - walked) >= _MAX_VIEWED
            try:
                values = {} if enough else decoder.decode(raw)[0]
            except MessageError:
                values = {}
            viewed += len(values)
            for name, value in values.items():
                if name not in columns and len(columns) >= MAX_FIELDS:
                    continue
                column = columns.setdefault(name, [])
                column.extend([None] * (i - len(column)))
                column.append(value)
        for column in columns.values():
            column.extend([None] * (len(messages.raw) - len(column)))
    shown: dict[str, list[Value]] = {}
    nulled = 0
    for name, column in columns.items():
        # Nobody could ask for a longer name.
        if len(name) <= MAX_FIELD_CHARACTERS:
            shown[name], several = wire_column(name, column)
            nulled += several
    return shown, nulled


def as_columns(messages: Messages, times_us: Sequence[int]) -> tuple[dict[str, list[Value]], str] | None:
    """Messages as columns for the wire and, as JSON, what else it takes to make them again; None where
    they are better kept, or can only be kept, as they are."""
    if not messages.layout:
        return None
    decoder = decoder_of(messages.layout)
    bodies = _bodies(decoder, messages.raw)
    if decoder.flat is None or bodies is None:
        return None
    columns: dict[str, list[Value]] = {}
    if max(map(len, decoder.flat[1])) > MAX_FIELD_CHARACTERS:
        return None
    for name, column in _columns(decoder, bodies).items():
        columns[name] = wire_column(name, column)[0]
        # What is no step is longer as text than its bytes are.
        if float in set(map(type, columns[name])) and packed(columns[name])[0] is None:
            return None
    if b"".join(bodies) != _rows(decoder, columns):
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
    return columns, COMPACT.encode(about)


def from_columns(
    columns: Mapping[str, Sequence[Value]], about: str, times_us: Sequence[int], layouts: Mapping[str, str]
) -> Messages:
    """The messages of `as_columns` again; ``layouts`` has the layout of each type by its id.

    Raises `ContractError` where it lacks the type's, or the columns are not of it.
    """
    n = len(times_us)
    try:
        name, *head = json.loads(about)
        if not isinstance(name, str) or name not in layouts:
            raise ContractError(f"the messages' type, {shown(name)}, is not known")
        decoder = decoder_of(layouts[name])
        if decoder.flat is None:
            raise ContractError(f"the type {name} is not of numbers alone")
        rows = _rows(decoder, columns)
        size = decoder.flat[0].size
        if len(rows) != n * size:
            raise ContractError(f"the columns are not of the type {name}")
        raw = [rows[i * size : (i + 1) * size] for i in range(n)]
        if decoder.stamped:
            seq, stamp, frame = head
            seqs = range(seq, seq + n) if type(seq) is int else unpacked(CODEC, "seq", seq, n)
            offsets: Sequence[Any] = (
                [int(stamp[3 * i : 3 * i + 3]) for i in range(n)]
                if isinstance(stamp, str)
                else unpacked(CODEC, "stamp", stamp, n)
            )
            # One stands for all: it is written once, and made so often.
            texts = [frame] * n if isinstance(frame, str) else frame
            if not isinstance(texts, list) or len(texts) != n or sum(map(len, texts)) > _MAX_FRAMES:
                raise ContractError(f"frame_id: expected {n} texts of up to {_MAX_FRAMES} characters")
            heads = map(_head, seqs, times_us, offsets, texts)
            raw = [start + body for start, body in zip(heads, raw)]
    except (AttributeError, RecursionError, TypeError, ValueError, struct.error) as error:
        if isinstance(error, ContractError):
            raise
        raise ContractError(f"the messages cannot be made again: {error}") from error
    return Messages(name, layouts[name], raw)


def _head(seq: Any, t_us: int, offset_ns: Any, frame: str) -> bytes:
    sec, nanosec = divmod(t_us * 1000 + offset_ns, _NS)
    text = str.encode(frame)
    return HEADER.pack(seq, sec, nanosec, len(text)) + text


def _digits(offsets: Sequence[int]) -> str:
    """Offsets within a microsecond as three digits each, which nothing packs better; empty for others."""
    if min(offsets) < 0 or max(offsets) > 999:
        return ""
    return "".join(map("{:03d}".format, offsets))


def _bodies(decoder: Decoder, raws: Iterable[bytes]) -> list[bytes] | None:
    """What is behind the headers, where that is as long as the layout says."""
    if decoder.flat is None:
        return None
    size = decoder.flat[0].size
    if not decoder.stamped:
        bodies = list(raws)
    else:
        try:
            bodies = [raw[HEADER.size + HEADER.unpack_from(raw)[3] :] for raw in raws]
        except struct.error:
            return None
    return bodies if set(map(len, bodies)) == {size} else None


def _columns(decoder: Decoder, bodies: Sequence[bytes]) -> dict[str, list[Value]]:
    assert decoder.flat is not None
    reader, names = decoder.flat
    return dict(zip(names, map(list, zip(*reader.iter_unpack(b"".join(bodies))))))


def _rows(decoder: Decoder, columns: Mapping[str, Sequence[Value]]) -> bytes:
    """The messages' bodies behind one another; empty where a value does not fit."""
    assert decoder.flat is not None
    writer, names = decoder.flat
    if columns.keys() != set(names):
        return b""
    try:
        return b"".join([writer.pack(*row) for row in zip(*(columns[name] for name in names))])
    except (struct.error, OverflowError):
        return b""
