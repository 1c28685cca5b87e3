"""Compiles message types for the decoder: neighbouring numbers become one `struct.Struct`."""

from __future__ import annotations

import struct
from typing import Callable, Iterator, NamedTuple, Tuple, Union

from iort_contract.limits import MAX_FIELDS
from iort_contract.ros1.definition import LETTERS, STRING, VARIABLE, Field, Fields

# An array of more elements is not shown, and read apart from its neighbours.
MAX_ELEMENTS = 64
_MAX_PREFIXES = 1000


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
            whole = Extent(sum(one.size for one in fixed), sum(one.numbers for one in fixed))
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
