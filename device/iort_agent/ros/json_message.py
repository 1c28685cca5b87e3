"""JSON as a message of ROS 1 or ROS 2 and back, by the message's own definition.

Two writers of JSON are known. People and programs write commands: those are `encode`d strictly, as nothing in
a command may be guessed. A rosbridge server writes what a publisher sent: a `Writer` that is not ``strict``
takes its base64 for ``uint8[]`` and its null for NaN. Both take ROS 1's and ROS 2's names for the parts of a
time, and a header without a seq, as ROS 2 has none and leaves out another's. A message of ROS 2 is written as
little-endian CDR, and its bounds hold: the middleware would not publish what is beyond them.
"""

from __future__ import annotations

import binascii
import math
import struct
from contextlib import suppress
from operator import itemgetter
from typing import Any, Callable, List, Mapping, NamedTuple, Sequence, Union

from iort_contract.limits import MessageError
from iort_contract.ros.definition import (
    DURATION,
    HEADER_TYPE,
    LETTERS,
    STRING,
    TEXTS,
    TIME,
    VARIABLE,
    Definition,
    Field,
    short_kind,
)
from iort_contract.ros.plan import CDR_LITTLE, CDR_START, SIZES, cdr_order, cdr_text, fits, is_loose, padding

_LENGTH = struct.Struct("<I")
# A message of JSON within the broker's limit has no more elements; nested empty ones could have.
_MAX_ELEMENTS = 100_000
_MAX_NANOSEC = 999_999_999
# The names that ROS 1 and roslibjs give to the parts of a time.
_ROS1_TIME = {"secs": "sec", "nsecs": "nanosec"}
# rosbridge sends arrays of these as base64.
_BYTES = ("uint8", "char")
# `struct` packs any object as a bool; as an unsigned byte it must be true, false or a number.
_LETTERS = {**LETTERS, "bool": "B"}


def encode(
    definition: Definition, message: Mapping[str, Any], *, now_us: int, partial: bool = False
) -> bytes:
    """The message's bytes. Raises `MessageError`, which names the field, for a message of another type.

    A missing header is filled with the time now; with ``partial``, every missing field is zero.
    """
    if definition.stamped() and isinstance(message, dict) and "header" not in message:
        sec, microseconds = divmod(now_us, 1_000_000)
        stamp = {"sec": sec, "nanosec": microseconds * 1000}
        message = {**message, "header": {"stamp": stamp, "frame_id": ""}}
    return Writer(definition, strict=True, partial=partial).write(message)


def decode(definition: Definition, data: bytes) -> dict[str, Any]:
    """The message as JSON. Raises `MessageError` if the bytes do not fit the definition."""
    reader = _Reader(definition, data)
    try:
        message = reader.read(Field("", short_kind(definition.kind), None))
    except struct.error as error:
        raise MessageError(f"{definition.kind}: the message of {len(data)} bytes is truncated") from error
    if not fits(reader.at, len(data), ros2=definition.ros2, loose=reader.loose):
        raise MessageError(f"{definition.kind}: the message must have {reader.at} bytes, got {len(data)}")
    assert isinstance(message, dict)
    return message


class _Numbers(NamedTuple):
    """Neighbouring fields with one number each: they are packed by one call, if all are there and fit."""

    get: Callable[[Any], Sequence[Any]]
    struct: struct.Struct
    fields: Sequence[Field]


_Plan = List[Union[_Numbers, Field]]


class Writer:
    """Writes the messages of one definition; not for several threads at once. ``nulls`` counts the numbers
    that were null and are NaN in the message."""

    def __init__(self, definition: Definition, *, strict: bool = False, partial: bool = False) -> None:
        self.nulls = 0
        self._definition = definition
        self._strict = strict
        self._partial = partial
        self._plans: dict[str, _Plan] = {}
        self._ros2 = definition.ros2
        self._parts = bytearray()

    def write(self, message: Any) -> bytes:
        """The message's bytes. Raises `MessageError`, which names the field, for a message of another
        type."""
        self._parts = bytearray(CDR_LITTLE + b"\0\0" if self._ros2 else b"")
        try:
            self._message(short_kind(self._definition.kind), message, "")
        except RecursionError as error:
            raise MessageError(f"{self._definition.kind}: the message is nested too deeply") from error
        return bytes(self._parts)

    def _align(self, size: int) -> None:
        if self._ros2:
            self._parts += bytes(padding(len(self._parts), size))

    def _add_length(self, length: int) -> None:
        self._align(4)
        self._parts += _LENGTH.pack(length)

    def _message(self, kind: str, value: Any, path: str) -> None:
        if kind not in self._plans:
            # A message of ROS 2 is written field by field.
            self._plans[kind] = _plan(self._definition, kind, strict=self._strict or self._ros2)
        fields = self._definition.fields(kind)
        if type(value) is not dict:
            raise _wrong(path, value, f"an object of {', '.join(f.name for f in fields) or 'no fields'}")
        if kind in (TIME, DURATION):
            value = _time(value, path, strict=self._strict)
        unknown = sorted(map(str, value.keys() - {field.name for field in fields}))
        if self._ros2 and kind == HEADER_TYPE and unknown == ["seq"]:
            unknown = []
        if unknown:
            raise MessageError(f"{_join(path, unknown[0])}: {kind} has no such field")
        if self._ros2 and not fields:
            self._parts += b"\0"
        for part in self._plans[kind]:
            if isinstance(part, Field):
                self._member(kind, part, value, path)
                continue
            try:
                self._parts += part.struct.pack(*part.get(value))
            except (KeyError, struct.error, OverflowError):
                # Field by field: for a null, for an optional field, or for the error.
                for field in part.fields:
                    self._member(kind, field, value, path)

    def _member(self, kind: str, field: Field, message: Mapping[str, Any], path: str) -> None:
        below = _join(path, field.name)
        if field.name in message:
            self._put(field, message[field.name], below)
        elif self._partial or (kind == HEADER_TYPE and field.name == "seq"):
            self._put(field, _zero(field), below)
        else:
            raise MessageError(f"{below}: is missing")

    def _put(self, field: Field, value: Any, path: str) -> None:
        if field.length is not None:
            self._array(field, value, path)
        elif field.kind in LETTERS:
            self._align(SIZES[field.kind])
            self._parts += self._number(field.kind, value, path)
        elif field.kind in TEXTS:
            self._text(field, value, path)
        else:
            self._message(field.kind, value, path)

    def _text(self, field: Field, value: Any, path: str) -> None:
        text = _encoded(value, path, "utf-8" if field.kind == STRING else "utf-16-le")
        units = len(text) if field.kind == STRING else len(text) // 2
        # Of a wstring, each unit of UTF-16 counts.
        if field.longest is not None and units > field.longest:
            raise MessageError(f"{path}: must have at most {field.longest} bytes, got {units}")
        if field.kind == STRING and self._ros2:
            if b"\0" in text:
                raise _wrong(path, value, "a text without NUL")
            text += b"\0"
            units += 1
        elif field.kind != STRING:
            text = struct.pack(f"<{units}I", *struct.unpack(f"<{units}H", text))
        self._add_length(units)
        self._parts += text

    def _array(self, field: Field, value: Any, path: str) -> None:
        element = field.element()
        if value is _ZEROS:
            value = [_zero(element)] * (field.length or 0)
        if type(value) is str and field.kind in _BYTES and not self._strict:
            try:
                value = binascii.a2b_base64(value)
            except ValueError as error:
                raise _wrong(path, value, "base64") from error
        elif type(value) is not list or (self._strict and len(value) > _MAX_ELEMENTS):
            raise _wrong(path, value, f"a list of up to {_MAX_ELEMENTS}")
        if field.length == VARIABLE:
            if field.most is not None and len(value) > field.most:
                raise MessageError(f"{path}: must have at most {field.most} elements, got {len(value)}")
            self._add_length(len(value))
        elif len(value) != field.length:
            raise MessageError(f"{path}: must have {field.length} elements, got {len(value)}")
        if field.kind in LETTERS and not self._strict:
            # If that fails: element by element, for a null or for the error.
            with suppress(struct.error, OverflowError):
                letters = f"<{len(value)}{_LETTERS[field.kind]}"
                numbers = value if type(value) is bytes else struct.pack(letters, *value)
                if numbers:
                    self._align(SIZES[field.kind])
                self._parts += numbers
                return
        for i, item in enumerate(value):
            self._put(element, item, f"{path}.{i}")

    def _number(self, kind: str, value: Any, path: str) -> bytes:
        letter = LETTERS[kind]
        if letter in "fd":
            value = self._float(kind, value, path)
        elif letter == "?" and type(value) is not bool:
            raise _wrong(path, value, "true or false")
        elif letter != "?":
            # A browser writes 1 for 1.0 and cannot tell them apart, so a whole number may be an integer.
            if self._strict and type(value) is float and value.is_integer():
                value = int(value)
            if type(value) is not int:
                raise _wrong(path, value, "an integer")
        try:
            return struct.pack(f"<{letter}", value)
        except (struct.error, OverflowError) as error:
            raise _wrong(path, value, f"a number that fits in {kind}") from error

    def _float(self, kind: str, value: Any, path: str) -> float:
        if value is None and not self._strict:
            self.nulls += 1
            return math.nan
        if type(value) not in (int, float):
            raise _wrong(path, value, "a number")
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        if self._strict and not math.isfinite(value):
            raise _wrong(path, value, f"a number that fits in {kind}")
        return float(value)


def _plan(definition: Definition, kind: str, *, strict: bool) -> _Plan:
    """A type's fields, with neighbouring numbers together. A strict writer looks at each number."""
    plan: _Plan = []
    numbers: list[Field] = []
    for field in [*definition.fields(kind), None]:
        if field is not None and field.kind in LETTERS and field.length is None and not strict:
            numbers.append(field)
            continue
        if numbers:
            letters = "".join(_LETTERS[number.kind] for number in numbers)
            names = [number.name for number in numbers]
            # Of one name, itemgetter gives the value and no tuple.
            get = itemgetter(*names) if len(names) > 1 else _one(names[0])
            plan.append(_Numbers(get, struct.Struct(f"<{letters}"), numbers))
            numbers = []
        if field is not None:
            plan.append(field)
    return plan


def _one(name: str) -> Callable[[Any], Sequence[Any]]:
    return lambda message: (message[name],)


_ZEROS = object()


def _zero(field: Field) -> Any:
    if field.length is not None:
        return [] if field.length == VARIABLE else _ZEROS
    if field.kind == "bool":
        return False
    if field.kind in LETTERS:
        return 0
    return "" if field.kind in TEXTS else {}


def _time(value: Mapping[str, Any], path: str, *, strict: bool) -> dict[str, Any]:
    """A time or duration under the names that the definition has."""
    if value.keys() & _ROS1_TIME.keys() and value.keys() & set(_ROS1_TIME.values()):
        raise MessageError(f"{path}: must have one spelling of a time, got {', '.join(value)}")
    found = {_ROS1_TIME.get(name, name): each for name, each in value.items()}
    nanosec = found.get("nanosec", 0)
    if strict and isinstance(nanosec, (int, float)) and not 0 <= nanosec <= _MAX_NANOSEC:
        raise _wrong(_join(path, "nanosec"), nanosec, f"an integer from 0 to {_MAX_NANOSEC}")
    return found


def _encoded(value: Any, path: str, encoding: str) -> bytes:
    if not isinstance(value, str):
        raise _wrong(path, value, "a text")
    try:
        return value.encode(encoding)
    except UnicodeEncodeError as error:
        raise _wrong(path, value, "a text of Unicode") from error


def _wrong(path: str, value: Any, allowed: str) -> MessageError:
    got = repr(value) if not isinstance(value, (dict, list)) else type(value).__name__
    return MessageError(f"{path or 'the message'}: must be {allowed}, got {got[:60]}")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


class _Reader:
    """Reads a message's bytes from ``at`` on, and counts what is ``loose`` for `fits`."""

    def __init__(self, definition: Definition, data: bytes) -> None:
        self.at = self.loose = 0
        self._definition = definition
        self._data = data
        self._ros2 = definition.ros2
        self._order = "<"
        if self._ros2:
            self.at = CDR_START
            self._order = cdr_order(definition.kind, data)

    def read(self, field: Field) -> Any:
        """The field's value; raises `struct.error` for bytes that end too early."""
        if field.length is not None:
            n = self._number("uint32") if field.length == VARIABLE else field.length
            if n > _MAX_ELEMENTS:
                raise MessageError(f"{field.name}: must have at most {_MAX_ELEMENTS} elements, got {n}")
            self.loose += is_loose(field.kind, n)
            return [self.read(field.element()) for _ in range(n)]
        if field.kind in LETTERS:
            return self._number(field.kind)
        if field.kind in TEXTS:
            self.loose += is_loose(field.kind, 1)
            n = self._number("uint32") * (1 if field.kind == STRING else 4)
            if self.at + n > len(self._data):
                raise struct.error
            content = self._data[self.at : self.at + n]
            self.at += n
            return (
                cdr_text(field.kind, content, self._order)
                if self._ros2
                else content.decode("utf-8", "replace")
            )
        fields = self._definition.fields(field.kind)
        if self._ros2 and not fields:
            self.at += 1
        return {nested.name: self.read(nested) for nested in fields}

    def _number(self, kind: str) -> Any:
        if self._ros2:
            self.at += padding(self.at, SIZES[kind])
        (number,) = struct.unpack_from(f"{self._order}{LETTERS[kind]}", self._data, self.at)
        self.at += SIZES[kind]
        return number
