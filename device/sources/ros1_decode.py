"""A ROS 1 message's bytes as one flat sample, by the definition that the publisher sends.

A definition is compiled once to a list of steps: neighbouring fixed-size fields are one
`struct.Struct`, in which what is not wanted is padding. Names follow the rule of
`device.sources.flatten`, and time and duration are ``sec`` and ``nanosec`` as in ROS 2, so that a
topic gives the same fields live, from a bag and through rosbridge. Left out, and counted, is what is
no telemetry: arrays of more than `MAX_ELEMENTS`, ``uint8[]`` of any length, texts that the contract
would refuse. With ``large``, a ``uint8[]`` stays the bytes that it is, for `device.claim_check` to take. An
element named in the selection (``ranges.540``) is taken from any array.
"""

from __future__ import annotations

import struct
from typing import Any, Callable, Dict, Optional, Sequence, Tuple

from contract import MAX_FIELDS, Value
from device.errors import MessageError
from device.ros1_types import LETTERS, STRING, VARIABLE, Definition, Field
from device.sources.flatten import HEADER

MAX_ELEMENTS = 64
MAX_TEXT = 4096

# Reads from the bytes at an offset into the sample; returns the offset behind what it has read.
Step = Callable[[bytes, int, Dict[str, Value]], int]
# Whether a path is wanted by itself, and whether anything below it is.
Wanted = Callable[[str], bool]

_LENGTH = struct.Struct("<I")
# A header: seq, the stamp's seconds and nanoseconds, and the length of the frame_id that follows.
_HEADER = struct.Struct("<IIII")
_BLOBS = ("uint8", "char")


# A sample; the header's stamp in microseconds if the message has one and it was asked for; the header's
# frame_id, as bytes, if the message begins with a header: it is nearly always the same, which is seen
# without decoding it.
Decoded = Tuple[Dict[str, Value], Optional[int], Optional[bytes]]


class Decoder:
    """Decodes the messages of one definition. ``select`` are the paths wanted; None is for all.

    Raises `MessageError` for a definition that gives more fields than a sample may have. ``unknown``
    are selected paths that the message does not have; ``left_out`` counts what was, by path.
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
        self._stamped = definition.stamped()
        self._stamp = stamp and self._stamped
        self.left_out: dict[str, int] = {}
        compiler = _Compiler(definition, select, self.left_out, large=large)
        self._steps = compiler.message(headed=self._stamped)
        self.unknown = sorted(set(select or ()) - compiler.used)

    def decode(self, data: bytes) -> Decoded:
        """The sample in a message. Raises `MessageError` where the bytes do not fit the definition."""
        # Read here and not by steps: after a pause each function called costs as much as the work in it.
        values: dict[str, Value] = {}
        at, stamp_us, frame = 0, None, None
        try:
            if self._stamped:
                _, sec, nanosec, length = _HEADER.unpack_from(data)
                at = _HEADER.size + length
                frame = data[_HEADER.size : at]
                if self._stamp:
                    # Wholes and remainders apart, for a float of seconds would lose the last digits.
                    stamp_us = sec * 1_000_000 + nanosec // 1000
            for step in self._steps:
                at = step(data, at, values)
        except struct.error as error:
            raise MessageError(f"{self._kind}: the message of {len(data)} bytes is cut short") from error
        if at != len(data):
            raise MessageError(f"{self._kind}: the message has {len(data)} bytes, its definition {at}")
        if len(values) > MAX_FIELDS:
            raise MessageError(f"{self._kind}: the message has over {MAX_FIELDS} fields; select some")
        return values, stamp_us, frame


class _Compiler:
    """Turns types into steps. What is not kept is stepped over, in one step if its size is fixed."""

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
        self._emitted = 0
        self.used: set[str] = set()

    def message(self, *, headed: bool) -> list[Step]:
        """The steps of a whole message, behind its header if it begins with one; a stamped one thing is
        that thing."""
        run = _Run()
        names = [field.name for field in self._definition.fields()]
        lone = len(names) == 2 and HEADER in names
        for field in self._definition.fields()[1 if headed else 0 :]:
            if field.name == HEADER:
                self._skip(run, field)
            elif lone and field.length is None and field.kind in self._definition.types:
                self._fields(run, field.kind, "")
            else:
                self._field(run, field, field.name)
        return run.finish()

    def _fields(self, run: _Run, kind: str, prefix: str) -> None:
        for field in self._definition.fields(kind):
            if field.name == HEADER:
                self._skip(run, field)
            else:
                self._field(run, field, prefix + field.name)

    def _field(self, run: _Run, field: Field, path: str) -> None:
        if not self._within(path):
            self._skip(run, field)
        elif field.length is None:
            self._single(run, field.kind, path)
        elif field.length == VARIABLE:
            run.step(self._variable(field.kind, path))
        else:
            self._array(run, field, path, field.length)

    def _single(self, run: _Run, kind: str, path: str) -> None:
        if kind in self._definition.types:
            self._fields(run, kind, f"{path}.")
            return
        wanted = self._wanted(path)
        if wanted:
            self._emitted += 1
            if self._emitted > MAX_FIELDS:
                raise MessageError(f"{self._definition.kind}: has over {MAX_FIELDS} fields; select some")
        if kind == STRING:
            run.step(_text(path, self._left_out) if wanted else _skip_text)
        else:
            run.fixed(LETTERS[kind], path if wanted else None)

    def _array(self, run: _Run, field: Field, path: str, length: int) -> None:
        """An array of fixed length, which is so many fields."""
        whole = self._wanted(path)
        if whole and length > MAX_ELEMENTS:
            run.step(_noted(path, self._left_out))
        taken = range(length) if whole and length <= MAX_ELEMENTS else self._indexes(path, length)
        done = 0
        for i in taken:
            self._skip(run, Field(field.name, field.kind, i - done))
            self._single(run, field.kind, f"{path}.{i}")
            done = i + 1
        self._skip(run, Field(field.name, field.kind, length - done))

    def _variable(self, kind: str, path: str) -> Step:
        """An array whose length each message says."""
        size = self._size(kind)
        left_out = self._left_out
        whole, few = self._wanted(path), self._indexes(path, None)
        blob = kind in _BLOBS
        if blob and whole and self._large:
            return _bytes(path)
        elements: dict[int, list[Step]] = {}
        structs: dict[int, tuple[struct.Struct, list[str]]] = {}
        skip = self._element(kind, None)
        letter = LETTERS.get(kind)

        def steps(i: int) -> list[Step]:
            # Made when a message is first so long: most arrays stay short.
            if i not in elements:
                elements[i] = self._element(kind, f"{path}.{i}")
            return elements[i]

        def step(data: bytes, at: int, out: dict[str, Value]) -> int:
            (n,) = _LENGTH.unpack_from(data, at)
            at += 4
            all_of_it = whole and not blob and n <= MAX_ELEMENTS
            if whole and not all_of_it:
                left_out[path] = left_out.get(path, 0) + 1
            if size is not None and at + n * size > len(data):
                raise struct.error
            if all_of_it and letter:
                if n not in structs:
                    structs[n] = (struct.Struct(f"<{n}{letter}"), [f"{path}.{i}" for i in range(n)])
                reader, names = structs[n]
                out.update(zip(names, reader.unpack_from(data, at)))
                return at + int(reader.size)
            if size is not None:
                for i in range(n) if all_of_it else (i for i in few if i < n):
                    _walk(steps(i), data, at + i * size, out)
                return at + int(n) * size
            for i in range(n):
                at = _walk(steps(i) if all_of_it or i in few else skip, data, at, out)
            return at

        return step

    def _element(self, kind: str, path: str | None) -> list[Step]:
        run = _Run()
        emitted, self._emitted = self._emitted, 0
        if path is None:
            self._skip(run, Field("", kind, None))
        else:
            self._single(run, kind, path)
        self._emitted = emitted
        return run.finish()

    def _skip(self, run: _Run, field: Field) -> None:
        size = self._size(field.kind)
        if field.length == VARIABLE:
            run.step(_skip_many(size, None if size is not None else self._element(field.kind, None)))
        elif size is not None:
            run.pad(size * (1 if field.length is None else field.length))
        elif field.length is not None:
            if field.length:
                run.step(_repeated(self._element(field.kind, None), field.length))
        elif field.kind == STRING:
            run.step(_skip_text)
        else:
            for nested in self._definition.fields(field.kind):
                self._skip(run, nested)

    def _size(self, kind: str) -> int | None:
        """The bytes of a type, or None where a message's own content decides."""
        if kind in LETTERS:
            return struct.calcsize(f"<{LETTERS[kind]}")
        if kind == STRING:
            return None
        if kind not in self._sizes:
            total: int | None = 0
            for field in self._definition.fields(kind):
                size = None if field.length == VARIABLE else self._size(field.kind)
                if size is None:
                    total = None
                    break
                total = (total or 0) + size * (1 if field.length is None else field.length)
            self._sizes[kind] = total
        return self._sizes[kind]

    # What the selection says.

    def _wanted(self, path: str) -> bool:
        """Whether the path itself is asked for, by its own name or that of something around it."""
        if self._select is None:
            return True
        for name in self._select:
            if path == name or path.startswith(f"{name}."):
                self.used.add(name)
                return True
        return False

    def _within(self, path: str) -> bool:
        """Whether the path, or something in it, is asked for."""
        return self._wanted(path) or any(name.startswith(f"{path}.") for name in self._select or ())

    def _indexes(self, path: str, length: int | None) -> list[int]:
        """The elements of an array that are asked for by their numbers."""
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

    def __init__(self) -> None:
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
            self._steps.append(_fixed(reader, self._names) if self._names else _skip_bytes(reader.size))
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
        # ROS 1 does not say how a text is encoded.
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


def _skip_many(size: int | None, element: list[Step] | None) -> Step:
    def step(data: bytes, at: int, out: dict[str, Value]) -> int:
        (n,) = _LENGTH.unpack_from(data, at)
        at += 4
        if element is None:
            return at + int(n) * (size or 0)
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
