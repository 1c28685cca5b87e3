"""The plan by which a message's bytes are read: which numbers stand together, and how many bytes types have.

ROS 1 packs values without gaps. ROS 2's CDR aligns each number to its own size, up to 8, counted from the end
of the 4 bytes that tell the byte order; so the size of a type depends on its place modulo 8, its phase. In
ROS 1 every phase is 0. CDR differs in this, too: a text ends with a NUL that counts; a wstring has 4 bytes
for each unit of UTF-16, as Fast DDS and Cyclone DDS write it; an empty message has one byte; and bytes may
follow, which fill the message up to a multiple of 4 or were reserved for nothing.
"""

from __future__ import annotations

import re
import struct
from typing import Callable, Iterator, NamedTuple, Sequence, Tuple, Union

from iort_contract.limits import MAX_FIELDS, MessageError
from iort_contract.ros.definition import LETTERS, TEXTS, VARIABLE, WSTRING, Field, Fields

# An array of more elements is not shown, and read apart from its neighbours.
MAX_ELEMENTS = 64
_MAX_PREFIXES = 1000

# A message of ROS 2 begins with its byte order, and two bytes of options.
CDR_LITTLE, CDR_BIG = b"\0\1", b"\0\0"
CDR_START = 4
SIZES = {kind: struct.calcsize(f"<{letter}") for kind, letter in LETTERS.items()}


def padding(at: int, size: int) -> int:
    """The bytes of CDR from a place in a message to a number of this size."""
    return (CDR_START - at) % size


def fits(end: int, size: int, *, ros2: bool, loose: int = 0) -> bool:
    """Whether a message whose fields end there may have this size.

    ``loose`` counts the values in it that make Fast DDS reserve too much (`is_loose`).
    """
    return end == size or (
        ros2 and (size == end + padding(end, 4) or end < size <= end + (8 * loose and 8 * loose + 3))
    )


def is_loose(kind: str, length: int) -> bool:
    """Whether Fast DDS reserves up to 8 bytes more for such a value of ROS 2 than it writes.

    What it has not written stays at the end of a message that was serialized before it was published.
    """
    return kind == WSTRING or (length == 0 and SIZES.get(kind) == 8)


def cdr_order(kind: str, data: bytes) -> str:
    """The byte order of a message of ROS 2, as `struct` has it; raises `MessageError` for other encodings."""
    if data[:2] not in (CDR_LITTLE, CDR_BIG):
        raise MessageError(
            f"{kind}: the message must be plain CDR, and begin with 0000 or 0001, got {data[:2].hex()}"
        )
    return "<" if data[:2] == CDR_LITTLE else ">"


def cdr_text(kind: str, content: bytes, order: str) -> str:
    """The text in the bytes of a string or wstring of ROS 2; raises `MessageError` if they are none."""
    if kind == WSTRING:
        units = struct.unpack(f"{order}{len(content) // 4}I", content)
        if max(units, default=0) > 0xFFFF:
            raise MessageError("a character of a wstring must be below 65536")
        return struct.pack(f"<{len(units)}H", *units).decode("utf-16-le", "replace")
    # Some write an empty text without its NUL.
    if content[-1:] not in (b"", b"\0"):
        raise MessageError("a string must end with a NUL")
    return content[:-1].decode("utf-8", "replace")


class Extent(NamedTuple):
    """The bytes of a value of fixed size, by its phase, and how many numbers it has."""

    sizes: Sequence[int]
    numbers: int

    def times(self, n: int, phase: int) -> int:
        """The bytes of ``n`` such values, one behind the other."""
        if len(self.sizes) == 1:
            return n * self.sizes[0]
        total, count, seen = 0, 0, {phase: (0, 0)}
        while count < n:
            total += self.sizes[(phase + total) % 8]
            count += 1
            at = (phase + total) % 8
            if at in seen:
                # From here on the phases repeat.
                start, bytes_before = seen[at]
                rounds = (n - count) // (count - start)
                total += rounds * (total - bytes_before)
                count += rounds * (count - start)
                seen = {}
            else:
                seen[at] = count, total
        return total


# A number's kind and its path, which are empty for the byte of an empty type.
_Leaf = Tuple[str, str]


class Run:
    """Neighbouring numbers, read by one `struct.Struct`, which the first sample that needs it creates.

    ``compiled`` are those by phase and by prefix.
    """

    def __init__(self, fields: Fields, extent: Extent, types: Types) -> None:
        self.sizes, self.numbers = extent
        self._fields = fields
        self._types = types
        self._leaves: list[_Leaf] | None = None
        self.compiled: list[dict[str, tuple[struct.Struct, list[str]]]] = [{} for _ in extent.sizes]
        self._gaps: dict[int, list[int]] = {}

    def named(self, prefix: str, phase: int = 0) -> tuple[struct.Struct, list[str]]:
        """The struct that reads the wanted numbers, and their paths."""
        named = self.compiled[phase]
        if prefix not in named:
            if self._leaves is None:
                self._leaves = [leaf for field in self._fields for leaf in self._expand(field, field.name)]
            if len(named) >= _MAX_PREFIXES:
                named.clear()
            names, letters = [], [self._types.order]
            at = phase
            for kind, path in self._leaves:
                size = SIZES.get(kind, 1)
                gap = padding(at, size) if self._types.aligned else 0
                at += gap + size
                letters.append("x" * gap)
                if kind and self._types.wanted(prefix + path):
                    names.append(prefix + path)
                    letters.append(LETTERS[kind])
                else:
                    letters.append(f"{size}x")
            named[prefix] = struct.Struct("".join(letters)), names
        return named[prefix]

    def places(self, prefix: str, phase: int = 0) -> Iterator[tuple[str, int, str]]:
        """The wanted numbers: their paths, their places in the run, and their letters of `struct`."""
        reader, names = self.named(prefix, phase)
        paths, at = iter(names), 0
        for count, letter in re.findall(r"(\d*)([a-zA-Z?])", reader.format):
            if letter != "x":
                yield next(paths), at, letter
            at += struct.calcsize(f"<{count}{letter}")

    def gaps(self, phase: int) -> list[int]:
        """The places of the bytes that are no number's."""
        if phase in self._gaps:
            return self._gaps[phase]
        gaps: list[int] = []
        at = 0
        for count, letter in re.findall(r"(\d*)([a-zA-Z?])", self.named("", phase)[0].format):
            size = struct.calcsize(f"<{count}{letter}")
            gaps += range(at, at + size) if letter == "x" else ()
            at += size
        self._gaps[phase] = gaps
        return gaps

    def _expand(self, field: Field, path: str) -> Iterator[_Leaf]:
        extent = self._types.extent_of(field)
        # A type without numbers may have any number of fields.
        if extent is None or not extent.numbers:
            return
        nested = self._types.fields.get(field.kind, ())
        for i in range(1 if field.length is None else field.length):
            here = path if field.length is None else f"{path}.{i}"
            if not nested:
                yield (field.kind, here) if field.kind in LETTERS else ("", "")
            for inner in nested:
                yield from self._expand(inner, f"{here}.{inner.name}")


# A `Run`, or a field that is read by itself: a text, an array, a message of variable size.
Part = Union[Run, Field]


class Types:
    """The types of a definition, each compiled once. ``wanted`` tells whether a path is selected."""

    def __init__(
        self, fields: dict[str, Fields], wanted: Callable[[str], bool], *, aligned: bool, order: str
    ) -> None:
        self.fields = fields
        self.wanted = wanted
        self.aligned = aligned
        self.order = order
        self._phases = range(8 if aligned else 1)
        self._extents: dict[str, Extent | None] = dict.fromkeys(TEXTS)
        for kind, size in SIZES.items():
            sizes = [size + (padding(phase, size) if aligned else 0) for phase in self._phases]
            self._extents[kind] = Extent(sizes, 1)
        self._parts: dict[str, list[Part]] = {}

    def parts(self, kind: str) -> list[Part]:
        """The parts of a type."""
        if kind not in self._parts:
            fields, extent = self.fields[kind], self.extent(kind)
            # An empty type has no part, but may have a byte.
            empty = [] if fields or extent is None else [Run((), extent, self)]
            self._parts[kind] = self.compile(fields) or [*empty]
        return self._parts[kind]

    def compile(self, fields: Fields) -> list[Part]:
        """The parts of some fields."""
        parts: list[Part] = []
        run: list[Field] = []

        def finish() -> None:
            if run:
                extent = self._together(run)
                assert extent is not None
                parts.append(Run(tuple(run), extent, self))
                run.clear()

        for field in fields:
            extent = self.extent_of(field)
            if extent is not None and extent.numbers <= MAX_FIELDS:
                run.append(field)
                continue
            finish()
            parts.append(field)
        finish()
        return parts

    def extent(self, kind: str) -> Extent | None:
        """The extent of a type; None if its size varies."""
        if kind not in self._extents:
            fields = self.fields[kind]
            # A byte counts, so that no type has too many of them.
            empty = Extent([1] * len(self._phases), 1) if self.aligned and not fields else None
            self._extents[kind] = empty or self._together(fields)
        return self._extents[kind]

    def _together(self, fields: Sequence[Field]) -> Extent | None:
        """The extent of fields one behind the other; None if it varies."""
        extents = [self.extent_of(field) for field in fields]
        fixed = [extent for extent in extents if extent is not None]
        if len(fixed) < len(extents):
            return None
        sizes = []
        for phase in self._phases:
            at = phase
            for extent in fixed:
                at += extent.sizes[at % len(self._phases)]
            sizes.append(at - phase)
        return Extent(sizes, sum(extent.numbers for extent in fixed))

    def extent_of(self, field: Field) -> Extent | None:
        """The extent of a field; None if its size varies."""
        if field.length == 0:
            return Extent([0] * len(self._phases), 0)
        extent = None if field.length == VARIABLE else self.extent(field.kind)
        if extent is None or field.length is None:
            return extent
        # A long array is read apart, because its elements are left out.
        numbers = extent.numbers * field.length if field.length <= MAX_ELEMENTS else MAX_FIELDS + 1
        return Extent([extent.times(field.length, phase) for phase in self._phases], numbers)
