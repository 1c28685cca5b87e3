"""JSON as a rosbridge server sends it, as the bytes of the ROS 1 message that it was made of.

A definition is compiled once into a writer: numbers that follow each other, also those of nested messages,
are one `struct` call. rosbridge writes a time as ``secs`` and ``nsecs`` (ROS 2: ``sec`` and ``nanosec``), a
``uint8[]`` or ``char[]`` as a text of base64, and NaN and the infinities as null, which is NaN here. A header
of ROS 2 has no ``seq``; it is 0. All else must be as the definition says.
"""

from __future__ import annotations

import binascii
import math
import struct
from operator import itemgetter
from typing import Any, Callable, Iterable, List, Tuple

from iort_contract.limits import MessageError
from iort_contract.ros1.definition import (
    DURATION,
    HEADER_TYPE,
    LETTERS,
    STRING,
    TIME,
    VARIABLE,
    Definition,
    Field,
)

_LENGTH = struct.Struct("<I")
# What rosbridge sends as base64.
_BYTES = ("uint8", "char")
# `struct` takes anything for a bool; as an unsigned byte it must be true, false or a number.
_LETTERS = {**LETTERS, "bool": "B"}
_FLOATS = "fd"
# A fixed array of more elements is written as a variable one is, not element by element.
_MAX_INLINE = 64

# Takes a message's object, gives its numbers in the wire's order.
_Numbers = Callable[[Any], Iterable[Any]]
# Takes a value, appends its bytes to the parts.
_Write = Callable[[Any, List[bytes]], None]
_Gets = List[Tuple[str, _Numbers]]

_WRONG = (KeyError, TypeError, ValueError, AttributeError, struct.error, OverflowError, RecursionError)


class Writer:
    """Writes the messages of one definition; not for several threads at once."""

    def __init__(self, definition: Definition) -> None:
        self.kind = definition.kind
        self.nulls = 0
        self._definition = definition
        self._types: dict[str, _Write] = {}
        self._flats: dict[str, tuple[str, _Numbers] | None] = {}
        self._write = self._message(definition.kind)

    def write(self, message: Any) -> bytes:
        """The message's bytes; `nulls` counts the numbers that were null. Raises `MessageError` where the
        message is not of the definition."""
        parts: list[bytes] = []
        try:
            self._write(message, parts)
        except MessageError:
            raise
        except _WRONG as error:
            raise MessageError(f"{self.kind}: a message does not fit it: {error!r:.200}") from error
        return b"".join(parts)

    def _message(self, kind: str) -> _Write:
        if kind not in self._types:
            self._types[kind] = self._compile(kind)
        return self._types[kind]

    def _compile(self, kind: str) -> _Write:
        fields = self._definition.fields(kind)
        # Numbers are gathered into one call, until something comes whose size is not known.
        steps: list[_Write] = []
        letters, numbers = "", []
        for field in fields:
            flat = self._flat(field)
            if flat is not None:
                letters += flat[0]
                numbers.append((field.name, flat[1]))
                continue
            if numbers:
                steps.append(self._run(letters, _gather(kind, numbers)))
                letters, numbers = "", []
            steps.append(_member(_get(kind, field.name), self._variable(field)))
        if numbers:
            steps.append(self._run(letters, _gather(kind, numbers)))
        check = _checker(kind, [field.name for field in fields])

        def write(message: Any, parts: list[bytes]) -> None:
            check(message)
            for step in steps:
                step(message, parts)

        return write

    def _flat(self, field: Field) -> tuple[str, _Numbers] | None:
        """The letters and the numbers of a field that always has the same size; None for another."""
        if field.length is None:
            return self._flat_kind(field.kind)
        if field.length == VARIABLE or field.length > _MAX_INLINE or field.kind in _BYTES:
            return None
        element = self._flat_kind(field.kind)
        if element is None:
            return None
        count, (letters, numbers) = field.length, element
        nested = field.kind not in LETTERS

        def many(values: Any) -> Iterable[Any]:
            if type(values) is not list or len(values) != count:
                raise MessageError(f"{field.name}: found {values!r:.40}; allowed is a list of {count}")
            return [number for value in values for number in numbers(value)] if nested else values

        return letters * count, many

    def _flat_kind(self, kind: str) -> tuple[str, _Numbers] | None:
        if kind in LETTERS:
            return _LETTERS[kind], _one
        if kind == STRING:
            return None
        if kind == TIME:
            return "II", _time
        if kind == DURATION:
            return "ii", _time
        if kind not in self._flats:
            self._flats[kind] = self._flat_message(kind)
        return self._flats[kind]

    def _flat_message(self, kind: str) -> tuple[str, _Numbers] | None:
        letters, numbers = "", []
        fields = self._definition.fields(kind)
        for field in fields:
            flat = self._flat(field)
            if flat is None:
                return None
            letters += flat[0]
            numbers.append((field.name, flat[1]))
        check, gather = _checker(kind, [field.name for field in fields]), _gather(kind, numbers)

        def checked(message: Any) -> Iterable[Any]:
            check(message)
            return gather(message)

        return letters, checked

    def _run(self, letters: str, numbers: _Numbers) -> _Write:
        pack = struct.Struct(f"<{letters}").pack

        def run(message: Any, parts: list[bytes]) -> None:
            values = numbers(message)
            try:
                parts.append(pack(*values))
            except struct.error:
                parts.append(pack(*self._without_nulls(values, letters)))

        return run

    def _without_nulls(self, values: Iterable[Any], letters: str) -> list[Any]:
        """The numbers with NaN for null, where there may be one."""
        found = list(values)
        for i, (value, letter) in enumerate(zip(found, letters)):
            if value is None and letter in _FLOATS:
                found[i] = math.nan
                self.nulls += 1
        return found

    def _variable(self, field: Field) -> _Write:
        """What writes a field whose size is another with each message."""
        if field.length is not None:
            return self._array(field)
        return _text if field.kind == STRING else self._message(field.kind)

    def _array(self, field: Field) -> _Write:
        fixed = None if field.length == VARIABLE else field.length
        flat = self._flat_kind(field.kind)
        write = self._elements(field, flat)

        def array(values: Any, parts: list[bytes]) -> None:
            if type(values) is str and field.kind in _BYTES:
                values = binascii.a2b_base64(values)
            elif type(values) is not list:
                raise MessageError(f"{field.name}: found {values!r:.40}; allowed is a list")
            if fixed is None:
                parts.append(_LENGTH.pack(len(values)))
            elif len(values) != fixed:
                raise MessageError(f"{field.name}: has {len(values)} elements, and must have {fixed}")
            write(values, parts)

        return array

    def _elements(self, field: Field, flat: tuple[str, _Numbers] | None) -> _Write:
        if flat is None:
            one = _text if field.kind == STRING else self._message(field.kind)

            def each(values: Any, parts: list[bytes]) -> None:
                for value in values:
                    one(value, parts)

            return each
        letters, numbers = flat
        if field.kind in LETTERS:
            letter = letters

            def plain(values: Any, parts: list[bytes]) -> None:
                if type(values) is bytes:
                    parts.append(values)
                    return
                try:
                    parts.append(struct.pack(f"<{len(values)}{letter}", *values))
                except struct.error:
                    good = self._without_nulls(values, letter * len(values))
                    parts.append(struct.pack(f"<{len(values)}{letter}", *good))

            return plain
        run = self._run(letters, numbers)

        def messages(values: Any, parts: list[bytes]) -> None:
            for value in values:
                run(value, parts)

        return messages


def _checker(kind: str, names: list[str]) -> Callable[[Any], None]:
    """Refuses what is no object, and a field too many; one too few is found when it is looked for."""
    allowed, count = frozenset(names), len(names)
    optional = kind == HEADER_TYPE and "seq" in allowed

    def check(message: Any) -> None:
        if type(message) is not dict:
            raise MessageError(f"{kind}: found {message!r:.40}; allowed is an object")
        if len(message) != count and not (optional and message.keys() == allowed - {"seq"}):
            wrong = sorted(allowed.symmetric_difference(message))
            raise MessageError(f"{kind}: has the field {wrong[0]!r:.40} too many, or lacks it")

    return check


def _gather(kind: str, numbers: _Gets) -> _Numbers:
    """The numbers of several fields, one after the other."""
    if len(numbers) == 1:
        get, inner = _get(kind, numbers[0][0]), numbers[0][1]
        return lambda message: inner(get(message))
    if numbers and all(inner is _one for _, inner in numbers) and kind != HEADER_TYPE:
        return itemgetter(*(name for name, _ in numbers))
    gets = [(_get(kind, name), inner, inner is _one) for name, inner in numbers]

    def gather(message: Any) -> list[Any]:
        found: list[Any] = []
        for get, inner, single in gets:
            if single:
                found.append(get(message))
            else:
                found += inner(get(message))
        return found

    return gather


def _get(kind: str, name: str) -> Callable[[Any], Any]:
    if kind == HEADER_TYPE and name == "seq":
        return lambda message: message.get("seq", 0)
    return itemgetter(name)


def _member(get: Callable[[Any], Any], write: _Write) -> _Write:
    def member(message: Any, parts: list[bytes]) -> None:
        write(get(message), parts)

    return member


def _one(value: Any) -> Iterable[Any]:
    return (value,)


def _time(value: Any) -> Iterable[Any]:
    if len(value) != 2:
        raise MessageError(f"a time is {value!r:.40}")
    if "secs" in value:
        return value["secs"], value["nsecs"]
    return value["sec"], value["nanosec"]


def _text(value: Any, parts: list[bytes]) -> None:
    data = value.encode()
    parts.append(_LENGTH.pack(len(data)))
    parts.append(data)
