"""Decodes a ROS 1 message to a flat sample, by its definition: field path -> value.

This is the only rule of flattening. Nested messages give dotted paths and arrays give indexes:
``pose.position.x``, ``covariance.0``. Time and duration become ``sec`` and ``nanosec``, as in ROS 2. A
leading header is left out, because its stamp is the sample's time. A message of a header and exactly one
nested message (VescStateStamped, PoseStamped) gives that message's fields without a prefix.

The sample is a view; the record holds the message. The view leaves out and counts the fields that no table
shows: arrays of more than `MAX_ELEMENTS`, ``uint8[]`` of any length, texts of more than `MAX_TEXT`
characters, fields beyond `MAX_FIELDS`. `Types` compiles each type once: neighbouring numbers become one
`struct.Struct`.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from itertools import islice
from typing import Callable, Dict, Iterator, NamedTuple, Sequence, Tuple, Union

from iort_contract.limits import MAX_FIELDS, MessageError, Value
from iort_contract.ros.definition import LETTERS, STRING, VARIABLE, Definition, Field, Fields

MAX_TEXT = 4096
# A message with more elements of variable size in one array is not decoded.
_MAX_WALKED = 20_000
# A message of a fixed size has at most this many bytes.
_MAX_FIXED_BYTES = 2**31
# With a selection, this many fields are decoded before the rest of the message is skipped.
_MAX_SEARCHED = 20_000
_MAX_CACHED = 1000

# An array of more elements is not shown, and read apart from its neighbours.
MAX_ELEMENTS = 64
_MAX_PREFIXES = 1000

# A header begins with seq, the stamp's seconds and nanoseconds, and the length of the frame_id.
HEADER = struct.Struct("<IIII")
_LENGTH = struct.Struct("<I")
_BLOBS = ("uint8", "char")
_BEYOND = f"(fields beyond {MAX_FIELDS})"


def stamp_ns(message: bytes) -> int | None:
    """The header stamp of a stamped message; None if the message is too short to have one."""
    if len(message) < HEADER.size:
        return None
    _, sec, nanosec, _ = HEADER.unpack_from(message)
    return int(sec) * 1_000_000_000 + int(nanosec)


class Extent(NamedTuple):
    """The bytes of a value of fixed size, and how many numbers it has."""

    size: int
    numbers: int


_NUMBERS = {kind: Extent(struct.calcsize(f"<{letter}"), 1) for kind, letter in LETTERS.items()}
# A number's kind and its path.
_Leaf = Tuple[str, str]


class Run:
    """Neighbouring numbers, read by one `struct.Struct`, which the first sample that needs it creates."""

    def __init__(self, fields: Fields, extent: Extent, types: Types) -> None:
        self.size, self.numbers = extent
        self._fields = fields
        self._types = types
        self._leaves: list[_Leaf] | None = None
        self._named: dict[str, tuple[struct.Struct, list[str]]] = {}

    def named(self, prefix: str) -> tuple[struct.Struct, list[str]]:
        """The struct that reads the wanted numbers, and their paths."""
        if prefix not in self._named:
            if self._leaves is None:
                self._leaves = [leaf for field in self._fields for leaf in self._expand(field, field.name)]
            if len(self._named) >= _MAX_PREFIXES:
                self._named.clear()
            names, letters = [], []
            for kind, path in self._leaves:
                if self._types.wanted(prefix + path):
                    names.append(prefix + path)
                    letters.append(LETTERS[kind])
                else:
                    letters.append(f"{_NUMBERS[kind].size}x")
            self._named[prefix] = struct.Struct("<" + "".join(letters)), names
        return self._named[prefix]

    def _expand(self, field: Field, path: str) -> Iterator[_Leaf]:
        extent = self._types.extent_of(field)
        # A type without numbers may have any number of fields.
        if extent is None or not extent.numbers:
            return
        for i in range(1 if field.length is None else field.length):
            here = path if field.length is None else f"{path}.{i}"
            if field.kind in LETTERS:
                yield field.kind, here
            for nested in self._types.fields.get(field.kind, ()):
                yield from self._expand(nested, f"{here}.{nested.name}")


# A `Run`, or a field that is read by itself: a text, an array, a message of variable size.
Part = Union[Run, Field]


class Types:
    """The types of a definition, each compiled once. ``wanted`` tells whether a path is selected."""

    def __init__(self, fields: dict[str, Fields], wanted: Callable[[str], bool]) -> None:
        self.fields = fields
        self.wanted = wanted
        self._extents: dict[str, Extent | None] = {**_NUMBERS, STRING: None}
        self._parts: dict[str, list[Part]] = {}

    def parts(self, kind: str) -> list[Part]:
        """The parts of a type."""
        if kind not in self._parts:
            self._parts[kind] = self.compile(self.fields[kind])
        return self._parts[kind]

    def compile(self, fields: Fields) -> list[Part]:
        """The parts of some fields."""
        parts: list[Part] = []
        run: list[Field] = []
        size = numbers = 0
        for field in fields:
            extent = self.extent_of(field)
            if extent is not None and extent.numbers <= MAX_FIELDS:
                run.append(field)
                size, numbers = size + extent.size, numbers + extent.numbers
                continue
            if run:
                parts.append(Run(tuple(run), Extent(size, numbers), self))
                run, size, numbers = [], 0, 0
            parts.append(field)
        return [*parts, Run(tuple(run), Extent(size, numbers), self)] if run else parts

    def extent(self, kind: str) -> Extent | None:
        """The extent of a type; None if its size varies."""
        if kind not in self._extents:
            extents = [self.extent_of(field) for field in self.fields[kind]]
            fixed = [extent for extent in extents if extent is not None]
            whole = Extent(sum(extent.size for extent in fixed), sum(extent.numbers for extent in fixed))
            self._extents[kind] = whole if len(fixed) == len(extents) else None
        return self._extents[kind]

    def extent_of(self, field: Field) -> Extent | None:
        """The extent of a field; None if its size varies."""
        if field.length == 0:
            return Extent(0, 0)
        extent = None if field.length == VARIABLE else self.extent(field.kind)
        if extent is None or field.length is None:
            return extent
        # A long array is read apart, because its elements are left out.
        numbers = extent.numbers * field.length if field.length <= MAX_ELEMENTS else MAX_FIELDS + 1
        return Extent(extent.size * field.length, numbers)


class Decoder:
    """Decodes the messages of one definition.

    ``select`` names the wanted paths, or their beginnings; None selects all. An element that is named
    (``ranges.540``) is taken from an array of any length. With ``large``, a ``uint8[]`` stays `Large` bytes.

    ``stamped`` is true if messages begin with a header. ``unknown`` are selected paths that the message does
    not have. ``left_out`` counts the omitted values by path. ``walked`` counts the elements of variable size
    that were read one by one, times their fields: the main cost of decoding. ``flat`` is the struct of a
    message that has only numbers after its header, and their names; None for other messages.
    """

    def __init__(
        self, definition: Definition, *, select: Sequence[str] | None = None, large: bool = False
    ) -> None:
        self.stamped = definition.stamped()
        self.left_out: dict[str, int] = {}
        self.walked = 0
        self._kind = definition.kind
        self._types = definition.types
        self._select = select
        self._large = large
        self._limit = MAX_FIELDS if select is None else _MAX_SEARCHED
        self._compiled = Types(definition.types, self.wanted)
        self._chosen: dict[str, bool] = {}
        body = definition.fields()[1 if self.stamped else 0 :]
        if self.stamped and len(body) == 1 and body[0].length is None and body[0].kind in self._types:
            body = self._types[body[0].kind]
        extent = self._compiled.extent(self._kind)
        if extent is not None and extent.size > _MAX_FIXED_BYTES:
            raise MessageError(f"{self._kind}: the message would be too large: {extent.size} bytes")
        self._body = self._compiled.compile(body)
        self.unknown = sorted(path for path in select or () if not self._has(path.split("."), body))
        self.flat: tuple[struct.Struct, list[str]] | None = None
        if len(self._body) == 1 and isinstance(self._body[0], Run) and self._body[0].numbers <= MAX_FIELDS:
            self.flat = self._body[0].named("") if self._body[0].numbers else None

    def decode(self, data: bytes) -> dict[str, Value]:
        """The message as a sample; raises `MessageError` if the bytes do not fit the definition."""
        values: dict[str, Value] = {}
        at = 0
        try:
            if self.stamped:
                at = HEADER.size + HEADER.unpack_from(data)[3]
            at = self._read(self._body, "", data, at, values)
        except struct.error as error:
            raise MessageError(f"{self._kind}: the message of {len(data)} bytes is truncated") from error
        if at != len(data):
            raise MessageError(f"{self._kind}: the message must have {at} bytes, got {len(data)}")
        if self._select is not None:
            values = {path: value for path, value in values.items() if self.wanted(path)}
        if len(values) > MAX_FIELDS:
            self._leave_out(_BEYOND)
            values = dict(islice(values.items(), MAX_FIELDS))
        return values

    # Reading. A path of None skips the value.

    def _read(self, parts: Sequence[Part], prefix: str | None, data: bytes, at: int, out: _Sample) -> int:
        for part in parts:
            # The next values would be cut from a full sample.
            shown = prefix is not None and len(out) <= self._limit
            if isinstance(part, Run):
                if shown:
                    reader, names = part.named(prefix or "")
                    out.update(zip(names, reader.unpack_from(data, at)))
                at += part.size
                continue
            path = f"{prefix}{part.name}" if shown else None
            if part.length is None:
                at = self._value(part.kind, path, data, at, out)
            else:
                at = self._array(part, path, data, at, out)
        return at

    def _value(self, kind: str, path: str | None, data: bytes, at: int, out: _Sample) -> int:
        if kind in self._types:
            return self._read(self._compiled.parts(kind), None if path is None else f"{path}.", data, at, out)
        if kind == STRING:
            (n,) = _LENGTH.unpack_from(data, at)
            if path is not None:
                # ROS 1 does not define the encoding of a text.
                text = data[at + 4 : at + 4 + n].decode("utf-8", "replace") if n <= 4 * MAX_TEXT else None
                if text is None or len(text) > MAX_TEXT:
                    self._leave_out(path)
                else:
                    out[path] = text
            return at + 4 + int(n)
        assert path is not None
        (out[path],) = struct.unpack_from(f"<{LETTERS[kind]}", data, at)
        return at

    def _array(self, field: Field, path: str | None, data: bytes, at: int, out: _Sample) -> int:
        kind, n = field.kind, field.length or 0
        blob = n == VARIABLE and kind in _BLOBS
        if n == VARIABLE:
            (n,) = _LENGTH.unpack_from(data, at)
            at += 4
        extent = self._compiled.extent(kind)
        if extent is not None and at + n * extent.size > len(data):
            raise struct.error
        shown: Sequence[int] = ()
        if path is not None and blob and self._large:
            out[path] = Large(data[at : at + n], at - _LENGTH.size)  # type: ignore[assignment]  # for the attachments
        elif path is not None and n <= MAX_ELEMENTS and not blob:
            shown = range(n)
        elif path is not None:
            shown = [i for i in _indexes(tuple(self._select or ()), _label(path)) if i < n]
            self._leave_out(path)
        # Empty arrays are no fields, so nothing limits their number: they must not cost names.
        if n and kind in LETTERS and isinstance(shown, range):
            out.update(zip(_element_names(path or ""), struct.unpack_from(f"<{n}{LETTERS[kind]}", data, at)))
        elif extent is not None:
            for i in shown if extent.numbers else ():
                if len(out) <= self._limit:
                    self._value(kind, f"{path}.{i}", data, at + i * extent.size, out)
        if extent is not None:
            return at + n * extent.size
        if n > _MAX_WALKED:
            raise MessageError(f"{path or kind}: too many elements to decode: {n}")
        self.walked += n * (len(self._compiled.parts(kind)) if kind in self._types else 1)
        for i in range(n):
            here = f"{path}.{i}" if i in shown and len(out) <= self._limit else None
            at = self._value(kind, here, data, at, out)
        return at

    def _leave_out(self, path: str) -> None:
        label = _label(path)
        if label == _BEYOND or self.wanted(label):
            self.left_out[label] = self.left_out.get(label, 0) + 1

    # The selection.

    def wanted(self, path: str) -> bool:
        """Whether a path is selected."""
        if self._select is None:
            return True
        if path not in self._chosen:
            if len(self._chosen) >= _MAX_SEARCHED:
                self._chosen.clear()
            self._chosen[path] = any(path == name or path.startswith(f"{name}.") for name in self._select)
        return self._chosen[path]

    def _has(self, parts: Sequence[str], fields: Fields) -> bool:
        """Whether a path can be in the messages."""
        field = next((field for field in fields if field.name == parts[0]), None)
        rest = parts[1:]
        if field is None or not rest:
            return field is not None
        if field.length is not None:
            if not rest[0].isdecimal() or 0 <= field.length <= int(rest[0]):
                return False
            rest = rest[1:]
        return not rest or self._has(rest, self._types.get(field.kind, ()))


class Large(bytes):
    """The bytes of an array, with the place of their length in the message: ``at``."""

    at: int

    def __new__(cls, content: bytes, at: int) -> Large:  # noqa: PYI034 - Python 3.8 has no Self
        large = super().__new__(cls, content)
        large.at = at
        return large


_Sample = Dict[str, Value]


@lru_cache(maxsize=_MAX_CACHED)
def _label(path: str) -> str:
    """The path without the indexes of elements."""
    return re.sub(r"\.\d+", "", path, flags=re.ASCII)


@lru_cache(maxsize=_MAX_CACHED)
def _element_names(path: str) -> list[str]:
    return [f"{path}.{i}" for i in range(MAX_ELEMENTS)]


@lru_cache(maxsize=_MAX_CACHED)
def _indexes(select: tuple[str, ...], label: str) -> list[int]:
    """The elements of an array that are selected by number."""
    pattern = re.compile(r"(?:\.\d+)*\.".join(label.split(".")) + r"\.(\d+)(?![^.])", re.ASCII)
    return sorted({int(match.group(1)) for match in map(pattern.match, select) if match})
