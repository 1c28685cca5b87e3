"""Serialized messages as columns and back: one sample per message, and the exact bytes again.

A message of numbers only, after its header (`Decoder.flat`), is written as columns, which take half the bytes
of the compressed message; its header is stored beside them, and in ROS 2 the bytes that are no number's. The
writer rebuilds the messages and compares them. If any bit differs (a NaN's, a negative zero's), or the
numbers do not become steps, the messages are stored unchanged.
"""

from __future__ import annotations

import json
import math
import struct
from contextlib import suppress
from functools import lru_cache
from typing import Any, Mapping, NamedTuple, Sequence

from iort_contract.checks import COMPACT, json_text, shown, wire_column
from iort_contract.codec import packed, unpacked
from iort_contract.limits import (
    MAX_BATCH_VALUES,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    ContractError,
    MessageError,
    Value,
)
from iort_contract.ros.decode import CDR_HEADER, HEADER, Decoder
from iort_contract.ros.definition import parse
from iort_contract.ros.message import MAX_LAYOUT, Messages
from iort_contract.ros.plan import CDR_LITTLE, CDR_START, Run, fits

_NS = 1_000_000_000
# The limit for all frame_ids of a batch, and for what is beside its numbers; messages with more are stored
# unchanged.
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
    if not messages.readable:
        return 0
    try:
        return len(decoder_of(messages.layout).decode(max(messages.raw, key=len)))
    except MessageError:
        return 0


def view(messages: Messages) -> tuple[dict[str, list[Value]], int]:
    """The messages' samples as columns, with None for a missing field; and the number of values that are
    not finite."""
    if not messages.readable:
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
    if not messages.readable:
        return None
    decoder = decoder_of(messages.layout)
    # Most messages whose numbers are no steps show it at once.
    raws = messages.raw
    numbers = _numbers(decoder, raws) if _steps(decoder, [raws[0], raws[len(raws) // 2], raws[-1]]) else None
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
    rows = _rows(numbers.readers, numbers.names, columns)
    about: list[Any] = [messages.type_id]
    if decoder.ros2:
        rests = _rests(decoder, numbers, messages.raw)
        if 2 * sum(map(len, rests)) > _MAX_FRAMES:
            return None
        rows = _completed(decoder, numbers.starts, rows, rests)
        about.append(_once([rest.hex() for rest in rests]))
    if rows != numbers.bodies:
        return None
    heads = _about_heads(decoder, messages.raw, numbers.starts, times_us) if decoder.stamped else []
    return None if heads is None else (written, COMPACT.encode([*about, *heads]))


def _steps(decoder: Decoder, raws: Sequence[bytes]) -> bool:
    """Whether the numbers of some of the messages could be steps."""
    numbers = _numbers(decoder, raws)
    if numbers is None:
        return False
    changing = [column for column in numbers.columns().values() if column.count(column[0]) < len(column)]
    floats = [column for column in changing if all(map(_finite, column))]
    return all(packed(column)[0] is not None for column in floats)


def _finite(value: Value) -> bool:
    return type(value) is float and math.isfinite(value)


def _about_heads(
    decoder: Decoder, raws: Sequence[bytes], starts: Sequence[int], times_us: Sequence[int]
) -> list[Any] | None:
    """What is needed to rebuild the headers; None if that would be too much."""
    heads = [(CDR_HEADER if decoder.ros2 else HEADER).unpack_from(raw) for raw in raws]
    first = (CDR_HEADER if decoder.ros2 else HEADER).size
    # In ROS 2, a text ends with a NUL.
    frames = [raw[first : start - decoder.ros2] for raw, start in zip(raws, starts)]
    try:
        texts = [frame.decode() for frame in frames]
    except UnicodeDecodeError:
        return None
    offsets = [sec * _NS + ns - 1000 * t_us for t_us, (*_, sec, ns, _) in zip(times_us, heads)]
    if any(ns >= _NS for *_, ns, _ in heads) or sum(map(len, frames)) > _MAX_FRAMES:
        return None
    about: list[Any] = [_digits(offsets) or packed(offsets), _once(texts)]
    if decoder.ros2:
        return about
    seqs = [head[0] for head in heads]
    return [seqs[0] if seqs == list(range(seqs[0], seqs[0] + len(seqs))) else packed(seqs), *about]


def from_columns(
    columns: Mapping[str, Sequence[Value]], about: str, times_us: Sequence[int], layouts: Mapping[str, str]
) -> Messages:
    """Rebuild the messages of `as_columns`; ``layouts`` has the layout of each type by its id.

    Raises `ContractError` for an unknown type, or columns of another type.
    """
    n = len(times_us)
    try:
        name, *head = json.loads(json_text(about, "the part after the columns"))
        if not isinstance(name, str) or name not in layouts:
            raise ContractError(f"the messages' type {shown(name)} is unknown")
        decoder = decoder_of(layouts[name])
        if decoder.flat is None:
            raise ContractError(f"type {name} must consist of numbers")
        names = decoder.flat.named("")[1]
        if columns.keys() != set(names):
            raise ContractError(f"the columns do not fit the type {name}")
        rests = [b""] * n
        if decoder.ros2:
            rests = list(map(bytes.fromhex, _each(head.pop(0), n, "the rest")))
        heads = [rest[:CDR_START] for rest in rests]
        if decoder.stamped:
            heads = _heads(decoder, heads, head, times_us)
        starts = list(map(len, heads))
        rows = _rows(_readers(decoder.flat, starts, ros2=decoder.ros2), names, columns)
        if len(rows) != n:
            raise ContractError(f"the columns do not fit the type {name}")
        if decoder.ros2:
            rows = _completed(decoder, starts, rows, rests)
        raw = [start + body for start, body in zip(heads, rows)]
    except (AttributeError, IndexError, RecursionError, TypeError, ValueError, struct.error) as error:
        if isinstance(error, ContractError):
            raise
        raise ContractError(f"the messages cannot be rebuilt: {error}") from error
    return Messages(name, layouts[name], raw)


def _heads(
    decoder: Decoder, starts: Sequence[bytes], about: Sequence[Any], times_us: Sequence[int]
) -> list[bytes]:
    """The headers, each behind the start of its message, which is empty in ROS 1."""
    n = len(times_us)
    # ROS 2 has no seq.
    seq, stamp, frame = [0, *about] if decoder.ros2 else about
    offsets: Sequence[Any] = (
        [int(stamp[3 * i : 3 * i + 3]) for i in range(n)]
        if isinstance(stamp, str)
        else unpacked("stamp", stamp, n)
    )
    times = [divmod(t_us * 1000 + offset_ns, _NS) for t_us, offset_ns in zip(times_us, offsets)]
    contents = list(map(str.encode, _each(frame, n, "frame_id")))
    if decoder.ros2:
        return [
            start + CDR_HEADER.pack(sec, nanosec, len(content) + 1)[CDR_START:] + content + b"\0"
            for start, (sec, nanosec), content in zip(starts, times, contents)
        ]
    seqs = range(seq, seq + n) if type(seq) is int else unpacked("seq", seq, n)
    return [
        HEADER.pack(number, sec, nanosec, len(content)) + content
        for number, (sec, nanosec), content in zip(seqs, times, contents)
    ]


def _once(texts: list[str]) -> str | list[str]:
    """A single text for all messages, if they are equal."""
    return texts if len(set(texts)) > 1 else texts[0]


def _each(texts: Any, n: int, what: str) -> list[str]:
    """Undo `_once`."""
    each = [texts] * n if isinstance(texts, str) else texts
    if not isinstance(each, list) or len(each) != n or sum(map(len, each)) > _MAX_FRAMES:
        raise ContractError(f"{what} must be {n} texts of at most {_MAX_FRAMES} characters")
    return each


def _digits(offsets: Sequence[int]) -> str:
    """Offsets within a microsecond as three digits each, the most compact form; empty for others."""
    if min(offsets) < 0 or max(offsets) > 999:
        return ""
    return "".join(map("{:03d}".format, offsets))


class _Numbers(NamedTuple):
    """Messages of numbers only: where the numbers begin, the bytes from there on, a struct for each message,
    and the names of the numbers."""

    starts: Sequence[int]
    bodies: list[bytes]
    readers: Sequence[struct.Struct]
    names: Sequence[str]

    def columns(self) -> dict[str, list[Value]]:
        """The numbers by name."""
        reader = self.readers[0]
        if len(set(self.readers)) == 1 and set(map(len, self.bodies)) == {reader.size}:
            rows = reader.iter_unpack(b"".join(self.bodies))
        else:
            rows = (reader.unpack_from(body) for reader, body in zip(self.readers, self.bodies))
        return dict(zip(self.names, map(list, zip(*rows))))


def _numbers(decoder: Decoder, raws: Sequence[bytes]) -> _Numbers | None:
    """The messages' numbers; None if there is anything else, or if a message has another length."""
    if decoder.flat is None:
        return None
    try:
        starts = [decoder.body(raw) if decoder.stamped else CDR_START * decoder.ros2 for raw in raws]
    except struct.error:
        return None
    readers = _readers(decoder.flat, starts, ros2=decoder.ros2)
    bodies = [raw[start:] for raw, start in zip(raws, starts)]
    fit = all(len(body) == reader.size for reader, body in zip(readers, bodies))
    if decoder.ros2:
        first = CDR_HEADER.size
        fit = all(
            raw[:2] == CDR_LITTLE
            and (not decoder.stamped or (start > first and raw[start - 1 : start] == b"\0"))
            and fits(start + reader.size, len(raw), ros2=True)
            for raw, start, reader in zip(raws, starts, readers)
        )
    return _Numbers(starts, bodies, readers, decoder.flat.named("")[1]) if fit else None


def _readers(run: Run, starts: Sequence[int], *, ros2: bool) -> list[struct.Struct]:
    if not ros2:
        return [run.named("")[0]] * len(starts)
    return [run.named("", start % 8)[0] for start in starts]


def _rows(
    writers: Sequence[struct.Struct], names: Sequence[str], columns: Mapping[str, Sequence[Value]]
) -> list[bytes]:
    """The messages without their headers; empty if a value does not fit."""
    try:
        rows = zip(*(columns[name] for name in names))
        return [writer.pack(*row) for writer, row in zip(writers, rows)]
    except (struct.error, OverflowError):
        return []


# What a message of ROS 2 has beside its header and its numbers: its start, the bytes of its gaps, and those
# that fill it up.


def _rests(decoder: Decoder, numbers: _Numbers, raws: Sequence[bytes]) -> list[bytes]:
    assert decoder.flat is not None
    rests = []
    for raw, start, reader in zip(raws, numbers.starts, numbers.readers):
        gaps = bytes([raw[start + gap] for gap in decoder.flat.gaps(start % 8)])
        rests.append(raw[:CDR_START] + gaps + raw[start + reader.size :])
    return rests


def _completed(
    decoder: Decoder, starts: Sequence[int], rows: Sequence[bytes], rests: Sequence[bytes]
) -> list[bytes]:
    """The rows with what they have beside their numbers."""
    assert decoder.flat is not None
    completed = []
    for start, row, rest in zip(starts, rows, rests):
        gaps = decoder.flat.gaps(start % 8)
        end = CDR_START + len(gaps)
        if not end <= len(rest) <= end + 3:
            raise ContractError(f"the rest must have {end} bytes and what fills them up, got {len(rest)}")
        if any(rest[CDR_START:end]):
            content = bytearray(row)
            for gap, byte in zip(gaps, rest[CDR_START:]):
                content[gap] = byte
            completed.append(bytes(content) + rest[end:])
        else:
            completed.append(row + rest[end:])
    return completed
