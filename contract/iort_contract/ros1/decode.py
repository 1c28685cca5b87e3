"""Decodes a ROS 1 message to one flat sample, by its definition: field path -> value.

A definition is compiled once to a list of steps. Neighbouring fixed-size fields become one `struct.Struct`,
with padding for unselected fields. Nested messages flatten to dotted paths and arrays to indexes:
``pose.position.x``, ``covariance.0``; time and duration become ``sec`` and ``nanosec`` as in ROS 2. A leading
header is left out: its stamp is the sample's time. A message of a header and exactly one nested message
(VescStateStamped, PoseStamped) gives that message's fields without a prefix.

The sample is a view; the record holds the message. The view leaves out, and counts, fields that no table
shows: arrays of more than `MAX_ELEMENTS`, ``uint8[]`` of any length, texts that the contract refuses, fields
beyond `MAX_FIELDS`. An element named in the selection (``ranges.540``) is taken from any array. With
``large``, a ``uint8[]`` stays bytes.
"""

from __future__ import annotations

import struct
from itertools import islice
from typing import Any, Callable, Dict, Optional, Sequence, Tuple

from iort_contract.limits import MAX_FIELDS, MessageError, Value
from iort_contract.ros1.definition import LETTERS, STRING, VARIABLE, Definition, Field

MAX_ELEMENTS = 64
MAX_TEXT = 4096
# Elements of variable size are walked one by one; a message with more is not decoded.
_MAX_WALKED = 20_000
# The limit of named places in a decoder: a few lines can nest to more than anybody can walk.
_MAX_NAMED = 20_000

# Reads from the bytes at an offset into the sample; returns the offset after the last byte read.
Step = Callable[[bytes, int, Dict[str, Value]], int]
# Whether a path is selected itself, and whether anything below it is.
Wanted = Callable[[str], bool]

_LENGTH = struct.Struct("<I")
# A header: seq, the stamp's seconds and nanoseconds, and the length of the frame_id that follows.
HEADER = struct.Struct("<IIII")
_BLOBS = ("uint8", "char")
_BEYOND = f"(fields beyond {MAX_FIELDS})"


# The sample; the header's stamp in microseconds, if it exists and was asked for; and a leading header's
# frame_id as bytes. The frame_id is nearly always the same, and the bytes can be compared without decoding.
Decoded = Tuple[Dict[str, Value], Optional[int], Optional[bytes]]


class Decoder:
    """Decodes the messages of one definition. ``select`` are the selected paths; None selects all.

    ``stamped`` says whether messages begin with a header. ``unknown`` are selected paths that the message
    does not have; ``left_out`` counts omitted values by path. ``flat`` is the layout of a message of numbers
    only, at fixed places after its header, and their names; None for all others.
    """

    def __init__(
        self,
        definition: Definition,
        *,
        select: Sequence[str] | None = None,
        stamp: bool = False,
        large: bool = False,
    ) -> None:
        self._kind = definition.kind
        self.stamped = definition.stamped()
        self._stamp = stamp and self.stamped
        self.left_out: dict[str, int] = {}
        compiler = _Compiler(definition, select, self.left_out, large=large)
        try:
            self._steps = compiler.message(headed=self.stamped)
        except struct.error as error:
            raise MessageError(f"{self._kind}: the message would be too large: {error}") from error
        self.unknown = sorted(set(select or ()) - compiler.used)
        self._walked = compiler.walked
        self.flat: tuple[struct.Struct, list[str]] | None = None
        if len(self._steps) == 1:
            self.flat = compiler.fixed.get(self._steps[0])

    @property
    def walked(self) -> int:
        """The number of walked elements of variable size, counting each of their fields. It is the main cost
        of decoding."""
        return self._walked[0]

    def decode(self, data: bytes) -> Decoded:
        """Decode a message; raises `MessageError` if the bytes do not fit the definition."""
        # The header is read inline, not by steps: after a pause each call costs as much as its work.
        values: dict[str, Value] = {}
        at, stamp_us, frame = 0, None, None
        try:
            if self.stamped:
                _, sec, nanosec, length = HEADER.unpack_from(data)
                at = HEADER.size + length
                frame = data[HEADER.size : at]
                if self._stamp:
                    # Seconds and the rest apart, since a float of seconds would lose the last digits.
                    stamp_us = sec * 1_000_000 + nanosec // 1000
            for step in self._steps:
                at = step(data, at, values)
        except struct.error as error:
            raise MessageError(f"{self._kind}: the message of {len(data)} bytes is truncated") from error
        if at != len(data):
            raise MessageError(f"{self._kind}: the message must have {at} bytes, got {len(data)}")
        if len(values) > MAX_FIELDS:
            self.left_out[_BEYOND] = self.left_out.get(_BEYOND, 0) + 1
            values = dict(islice(values.items(), MAX_FIELDS))
        return values, stamp_us, frame


class _Compiler:
    """Turns types into steps. An unselected field is skipped, in one step if its size is fixed."""

    def __init__(
        self,
        definition: Definition,
        select: Sequence[str] | None,
        left_out: dict[str, int],
        *,
        large: bool,
    ) -> None:
        self._definition = definition
        self._large = large
        self._select = select
        self._left_out = left_out
        self._sizes: dict[str, int | None] = {}
        self._skips: dict[str, list[Step]] = {}
        self._emitted = self._named = 0
        self.used: set[str] = set()
        self.walked = [0]
        self.fixed: dict[Step, tuple[struct.Struct, list[str]]] = {}

    def message(self, *, headed: bool) -> list[Step]:
        """The steps of a whole message, after a leading header. A message of a header and one nested message
        gives the nested message."""
        run = _Run(self.fixed)
        body = self._definition.fields()[1 if headed else 0 :]
        lone = headed and len(body) == 1
        for field in body:
            if lone and field.length is None and field.kind in self._definition.types:
                self._fields(run, field.kind, "")
            else:
                self._field(run, field, field.name)
        return run.finish()

    def _fields(self, run: _Run, kind: str, prefix: str) -> None:
        for field in self._definition.fields(kind):
            self._field(run, field, prefix + field.name)

    def _field(self, run: _Run, field: Field, path: str) -> None:
        self._named += 1
        if self._full() or not self._within(path):
            self._skip(run, field)
        elif field.length is None:
            self._single(run, field.kind, path)
        elif field.length == VARIABLE:
            run.step(self._variable(field.kind, path))
        else:
            self._array(run, field, path, field.length)

    def _full(self) -> bool:
        """Whether the sample is full; later fields are skipped as a whole."""
        return self._emitted > MAX_FIELDS or self._named > _MAX_NAMED

    def _single(self, run: _Run, kind: str, path: str) -> None:
        if kind in self._definition.types:
            self._fields(run, kind, f"{path}.")
            return
        wanted = self._wanted(path)
        if wanted:
            self._emitted += 1
            if self._emitted > MAX_FIELDS:
                if self._emitted == MAX_FIELDS + 1:
                    run.step(_noted(_BEYOND, self._left_out))
                wanted = False
        if kind == STRING:
            run.step(_text(path, self._left_out) if wanted else _skip_text)
        else:
            run.fixed(LETTERS[kind], path if wanted else None)

    def _array(self, run: _Run, field: Field, path: str, length: int) -> None:
        """An array of fixed length, decoded as single fields."""
        whole = self._wanted(path)
        if whole and length > MAX_ELEMENTS:
            run.step(_noted(path, self._left_out))
        taken = range(length) if whole and length <= MAX_ELEMENTS else self._indexes(path, length)
        done = 0
        for i in taken:
            if self._full():
                break
            self._skip(run, Field(field.name, field.kind, i - done))
            self._single(run, field.kind, f"{path}.{i}")
            done = i + 1
        self._skip(run, Field(field.name, field.kind, length - done))

    def _variable(self, kind: str, path: str) -> Step:
        """An array whose length is in each message."""
        size = self._size(kind)
        left_out, walked = self._left_out, self.walked
        whole, few = self._wanted(path), self._indexes(path, None)
        blob = kind in _BLOBS
        if blob and whole and self._large:
            return _bytes(path)
        elements: dict[int, list[Step]] = {}
        structs: dict[int, struct.Struct] = {}
        names: list[str] = []
        skip = self._skipped(kind)
        letter = LETTERS.get(kind)
        self._named += MAX_ELEMENTS if letter else 1

        def steps(i: int) -> list[Step]:
            # Created on the first message of this length: most arrays stay short.
            if i not in elements:
                if self._full():
                    return skip
                elements[i] = self._element(kind, f"{path}.{i}")
            return elements[i]

        def step(data: bytes, at: int, out: dict[str, Value]) -> int:
            (n,) = _LENGTH.unpack_from(data, at)
            at += 4
            all_of_it = whole and not blob and n <= MAX_ELEMENTS
            if whole and not all_of_it:
                left_out[path] = left_out.get(path, 0) + 1
            # The following values do not fit anyway.
            all_of_it = all_of_it and len(out) <= MAX_FIELDS
            if size is not None and at + n * size > len(data):
                raise struct.error
            if all_of_it and letter:
                reader = structs.get(n)
                if reader is None:
                    reader = structs[n] = struct.Struct(f"<{n}{letter}")
                    names.extend(f"{path}.{i}" for i in range(len(names), n))
                out.update(zip(names, reader.unpack_from(data, at)))
                return at + int(reader.size)
            if size is not None:
                for i in range(n) if all_of_it else (i for i in few if i < n):
                    _walk(steps(i), data, at + i * size, out)
                return at + int(n) * size
            if n > _MAX_WALKED:
                raise MessageError(f"{path}: too many elements to decode: {n}")
            walked[0] += n * len(skip)
            for i in range(n):
                at = _walk(steps(i) if all_of_it or i in few else skip, data, at, out)
            return at

        return step

    def _element(self, kind: str, path: str) -> list[Step]:
        run = _Run({})
        emitted, self._emitted = self._emitted, 0
        self._single(run, kind, path)
        self._emitted = emitted
        return run.finish()

    def _skip(self, run: _Run, field: Field) -> None:
        size = self._size(field.kind)
        if field.length == VARIABLE:
            run.step(_skip_many(size, self._skipped(field.kind), self.walked))
        elif size is not None:
            run.pad(size * (1 if field.length is None else field.length))
        elif field.length is None:
            for step in self._skipped(field.kind):
                run.step(step)
        elif field.length:
            run.step(_repeated(self._skipped(field.kind), field.length))

    def _skipped(self, kind: str) -> list[Step]:
        """The steps that skip one value of a type, created once."""
        if kind not in self._skips:
            run = _Run({})
            if self._size(kind) is not None:
                self._skip(run, Field("", kind, None))
            elif kind == STRING:
                run.step(_skip_text)
            else:
                inner = _Run({})
                for nested in self._definition.fields(kind):
                    self._skip(inner, nested)
                # One step, whatever its content.
                run.step(_repeated(inner.finish(), 1))
            self._skips[kind] = run.finish()
        return self._skips[kind]

    def _size(self, kind: str) -> int | None:
        """The size of a type in bytes, or None if it varies."""
        if kind in LETTERS:
            return struct.calcsize(f"<{LETTERS[kind]}")
        if kind == STRING:
            return None
        if kind not in self._sizes:
            total: int | None = 0
            for field in self._definition.fields(kind):
                if field.length == 0:
                    continue
                size = None if field.length == VARIABLE else self._size(field.kind)
                if size is None:
                    total = None
                    break
                total = (total or 0) + size * (1 if field.length is None else field.length)
            self._sizes[kind] = total
        return self._sizes[kind]

    # The selection.

    def _wanted(self, path: str) -> bool:
        """Whether the path is selected, by its own name or by a parent's."""
        if self._select is None:
            return True
        for name in self._select:
            if path == name or path.startswith(f"{name}."):
                self.used.add(name)
                return True
        return False

    def _within(self, path: str) -> bool:
        """Whether the path, or a path in it, is selected."""
        return self._wanted(path) or any(name.startswith(f"{path}.") for name in self._select or ())

    def _indexes(self, path: str, length: int | None) -> list[int]:
        """The array elements that are selected by number."""
        numbers = set()
        for name in self._select or ():
            if name.startswith(f"{path}."):
                index = name[len(path) + 1 :].partition(".")[0]
                if index.isdecimal() and (length is None or int(index) < length):
                    numbers.add(int(index))
                    if length is None:
                        self.used.add(name)
        return sorted(numbers)


class _Run:
    """Collects neighbouring fixed-size fields into one struct."""

    def __init__(self, fixed: dict[Step, tuple[struct.Struct, list[str]]]) -> None:
        self._of = fixed
        self._steps: list[Step] = []
        self._format: list[str] = []
        self._names: list[str] = []

    def fixed(self, letter: str, name: str | None) -> None:
        if name is None:
            self.pad(struct.calcsize(f"<{letter}"))
        else:
            self._format.append(letter)
            self._names.append(name)

    def pad(self, size: int) -> None:
        if size:
            self._format.append(f"{size}x")

    def step(self, step: Step) -> None:
        self.finish()
        self._steps.append(step)

    def finish(self) -> list[Step]:
        if self._format:
            reader = struct.Struct("<" + "".join(self._format))
            step = _fixed(reader, self._names) if self._names else _skip_bytes(reader.size)
            if len(self._format) == len(self._names):
                self._of[step] = reader, self._names
            self._steps.append(step)
            self._format, self._names = [], []
        return self._steps


# The steps.


def _walk(steps: list[Step], data: bytes, at: int, out: dict[str, Value]) -> int:
    for step in steps:
        at = step(data, at, out)
    return at


def _fixed(reader: struct.Struct, names: list[str]) -> Step:
    unpack, size = reader.unpack_from, reader.size

    def step(data: bytes, at: int, out: dict[str, Any]) -> int:
        out.update(zip(names, unpack(data, at)))
        return at + size

    return step


def _text(path: str, left_out: dict[str, int]) -> Step:
    def step(data: bytes, at: int, out: dict[str, Value]) -> int:
        (n,) = _LENGTH.unpack_from(data, at)
        at += 4
        # ROS 1 does not define the encoding of a text.
        text = data[at : at + n].decode("utf-8", "replace") if n <= 4 * MAX_TEXT else None
        if text is None or len(text) > MAX_TEXT:
            left_out[path] = left_out.get(path, 0) + 1
        else:
            out[path] = text
        return at + int(n)

    return step


def _bytes(path: str) -> Step:
    def step(data: bytes, at: int, out: dict[str, Any]) -> int:
        (n,) = _LENGTH.unpack_from(data, at)
        at += 4
        if at + n > len(data):
            raise struct.error
        out[path] = bytes(data[at : at + n])
        return at + int(n)

    return step


def _noted(path: str, left_out: dict[str, int]) -> Step:
    def step(_data: bytes, at: int, _out: dict[str, Value]) -> int:
        left_out[path] = left_out.get(path, 0) + 1
        return at

    return step


def _skip_text(data: bytes, at: int, _out: dict[str, Value]) -> int:
    return at + 4 + int(_LENGTH.unpack_from(data, at)[0])


def _skip_bytes(size: int) -> Step:
    return lambda _data, at, _out: at + size


def _skip_many(size: int | None, element: list[Step], walked: list[int]) -> Step:
    def step(data: bytes, at: int, out: dict[str, Value]) -> int:
        (n,) = _LENGTH.unpack_from(data, at)
        at += 4
        if size is not None:
            return at + int(n) * size
        if n > _MAX_WALKED:
            raise MessageError(f"too many elements to decode: {n}")
        walked[0] += n * len(element)
        for _ in range(n):
            at = _walk(element, data, at, out)
        return at

    return step


def _repeated(element: list[Step], times: int) -> Step:
    def step(data: bytes, at: int, out: dict[str, Value]) -> int:
        for _ in range(times):
            at = _walk(element, data, at, out)
        return at

    return step
