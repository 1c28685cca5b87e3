"""ROS 1 message types and the bytes of their messages, without ROS or a library.

A `Message` is a type with its nested types; it has the text that a publisher sends and its checksum.
`serialize` makes a message with values of a `Chance`, byte by byte; `fields` reads one as a flat list."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from iort_contract.ros.definition import RULE

SIZES = {
    "bool": 1, "int8": 1, "uint8": 1, "byte": 1, "char": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4,
    "int64": 8, "uint64": 8, "float32": 4, "float64": 8, "time": 8, "duration": 8,
}  # fmt: skip
_LETTERS = {
    "bool": "?", "int8": "b", "uint8": "B", "byte": "b", "char": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
    "time": "II", "duration": "ii",
}  # fmt: skip
STRING, HEADER = "string", "std_msgs/Header"
HEADER_TEXT = "uint32 seq\ntime stamp\nstring frame_id"
VARIABLE = -1
_FIELD = re.compile(r"(?P<base>[\w/]+?)(?P<array>\[(?P<length>\d*)\])?\s+(?P<name>\w+)\s*(=(?P<value>.*))?")


class Field(NamedTuple):
    """``kind`` is a full name; ``length`` is None for one value, `VARIABLE`, or the length of a fixed
    array.
    """

    name: str
    kind: str
    length: int | None


class Chance(Protocol):
    """Chooses the values of a message."""

    def number(self, kind: str, name: str) -> bytes:
        """Return a number of a type in `SIZES`, in its wire format."""

    def text(self, name: str) -> bytes:
        """Return a text, possibly with invalid UTF-8."""

    def length(self, name: str) -> int:
        """Return the length of a variable array."""


class Message:
    """A type and its nested types, from each type's own text."""

    def __init__(self, kind: str, texts: Mapping[str, str]) -> None:
        self.kind = kind
        self._texts = {HEADER: HEADER_TEXT, **texts}
        self.types: dict[str, list[Field]] = {}
        self._read(kind)
        first, *others = self.types
        self.definition = "\n".join(
            [self._texts[first], *(f"{RULE}\nMSG: {other}\n{self._texts[other]}" for other in others)]
        )
        self.md5sum = self._md5sum(kind)

    def __repr__(self) -> str:
        return f"{self.kind}:\n{self.definition}"

    @property
    def stamped(self) -> bool:
        """Return whether it begins with a header."""
        return self.types[self.kind][:1] == [Field("header", HEADER, None)]

    def _read(self, kind: str) -> None:
        if kind in self.types:
            return
        found: list[Field] = []
        self.types[kind] = found
        for match in self._lines(kind):
            if match["value"] is None:
                length = None if match["array"] is None else int(match["length"] or VARIABLE)
                found.append(Field(match["name"], self._full(kind, match["base"]), length))
        for field in found:
            if field.kind not in SIZES and field.kind != STRING:
                self._read(field.kind)

    def _lines(self, kind: str) -> list[re.Match[str]]:
        found = [_FIELD.match(line) for line in self._texts[kind].splitlines() if line.strip()]
        assert None not in found, self._texts[kind]
        return [match for match in found if match is not None]

    def _full(self, kind: str, name: str) -> str:
        if name in SIZES or name == STRING or "/" in name:
            return name
        return HEADER if name == "Header" else f"{kind.partition('/')[0]}/{name}"

    def _md5sum(self, kind: str) -> str:
        """Compute it as genmsg does: the constants, then the fields, with a nested type as its own
        checksum.
        """
        constants, plain = [], []
        for match in self._lines(kind):
            base, name, full = match["base"], match["name"], self._full(kind, match["base"])
            if match["value"] is not None:
                constants.append(f"{base} {name}={match['value'].strip()}")
            elif full in self.types:
                plain.append(f"{self._md5sum(full)} {name}")
            else:
                plain.append(f"{base}{match['array'] or ''} {name}")
        return hashlib.md5("\n".join(constants + plain).encode()).hexdigest()


def header(seq: int, stamp_us: int, frame: bytes) -> bytes:
    """A std_msgs/Header as bytes."""
    sec, us = divmod(stamp_us, 1_000_000)
    return struct.pack("<IIII", seq % 2**32, sec, us * 1000, len(frame)) + frame


def serialize(message: Message, chance: Chance, *, headed: bytes | None = None) -> bytes:
    """Make a message with values of ``chance``; ``headed`` is its header."""
    out: list[bytes] = []

    def one(kind: str, name: str) -> None:
        if kind in SIZES:
            out.append(chance.number(kind, name))
        elif kind == STRING:
            text = chance.text(name)
            out.append(struct.pack("<I", len(text)) + text)
        else:
            for field in message.types[kind]:
                several(field)

    def several(field: Field) -> None:
        count = 1 if field.length is None else field.length
        if count == VARIABLE:
            count = chance.length(field.name)
            out.append(struct.pack("<I", count))
        for _ in range(count):
            one(field.kind, field.name)

    for i, field in enumerate(message.types[message.kind]):
        if not i and headed is not None:
            out.append(headed)
        else:
            several(field)
    return b"".join(out)


def fields(message: Message, data: bytes) -> list[tuple[str, object]]:
    """Return path and value of every part of a message, in wire order; array and text lengths, as bytes,
    are values, too. A message that is too short or too long ends with a path that says so.
    """
    found: list[tuple[str, object]] = []

    def one(kind: str, path: str, at: int) -> int:
        if kind in SIZES:
            # NaN equals nothing, and -0.0 equals 0.0: compare bytes and value.
            raw = data[at : at + SIZES[kind]]
            found.append((path, (*struct.unpack(f"<{_LETTERS[kind]}", raw), raw.hex())))
            return at + SIZES[kind]
        if kind == STRING:
            (length,) = struct.unpack_from("<I", data, at)
            found.append((path, data[at + 4 : at + 4 + length]))
            return int(at + 4 + length)
        for field in message.types[kind]:
            at = several(field, f"{path}.{field.name}" if path else field.name, at)
        return at

    def several(field: Field, path: str, at: int) -> int:
        if field.length is None:
            return one(field.kind, path, at)
        count = field.length
        if count == VARIABLE:
            (count,) = struct.unpack_from("<I", data, at)
            found.append((f"{path}.length", count))
            at += 4
        if field.kind in {"uint8", "int8", "byte", "char"}:
            found.append((path, data[at : at + count]))
            return at + count
        for i in range(count):
            at = one(field.kind, f"{path}.{i}", at)
        return at

    try:
        end = one(message.kind, "", 0)
    except struct.error:
        found.append(("cut short", len(data)))
    else:
        if end != len(data):
            found.append(("too long", len(data) - end))
    return found


_BLOCKS = Path(__file__).with_name("ros1_messages.txt").read_text().rstrip().split("\n\nMSG: ")[1:]
TEXTS = {kind: text for kind, _, text in (block.partition("\n") for block in _BLOCKS)}
MESSAGES = {kind: Message(kind, TEXTS) for kind in sorted({*TEXTS, HEADER})}
TYPE = "vesc_msgs/VescStateStamped"
_STATE = MESSAGES["vesc_msgs/VescState"].types["vesc_msgs/VescState"]
FIELDS = [field.name for field in _STATE if field.kind == "float64"]
# The firmware sends integers; the driver divides these fields by the number, and the others by 1.
_PARTS = {
    "voltage_input": 10,
    "temperature_pcb": 10,
    "current_motor": 100,
    "current_input": 100,
    "duty_cycle": 1000,
}


def values(i: int) -> list[float]:
    """Return the fields of the i-th message with a VESC's digits; the speed is ``i``."""
    return [float(i) if name == "speed" else (115 + i % 97) / _PARTS.get(name, 1) for name in FIELDS]


def body(i: int) -> bytes:
    """Return the i-th message as ROS 1 serializes it, from the frame_id on."""
    return struct.pack(f"<I9s{len(FIELDS)}di", 9, b"base_link", *values(i), 0)
