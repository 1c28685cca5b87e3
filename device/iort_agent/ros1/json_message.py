"""JSON as a ROS 1 message and back, by the message's own definition, strictly.

Nothing is guessed: a field that the type does not have, one that is missing, a number that does not
fit, an array of another length are each a `MessageError` that names the field. Two things may be left
out: the header of a stamped message, which then says now, a header's seq, and, with ``partial``, any field,
which then is zero. Times are ``{"sec": 1, "nanosec": 2}``; ROS 1's own ``secs`` and ``nsecs`` are taken too.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Mapping

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
# A message of JSON within the broker's limit has no more elements; nested empties could.
_MAX_ELEMENTS = 100_000
_MAX_NANOSEC = 999_999_999
# As genpy and roslibjs call the fields of a time.
_SPELLINGS = {"secs": "sec", "nsecs": "nanosec"}


def encode(
    definition: Definition, message: Mapping[str, Any], *, now_us: int, partial: bool = False
) -> bytes:
    """The message's bytes. Raises `MessageError` for what the definition does not allow."""
    if definition.stamped() and isinstance(message, dict) and "header" not in message:
        sec, microseconds = divmod(now_us, 1_000_000)
        stamp = {"sec": sec, "nanosec": microseconds * 1000}
        message = {**message, "header": {"seq": 0, "stamp": stamp, "frame_id": ""}}
    writer = _Writer(definition, partial=partial)
    writer.put(Field("", definition.kind, None), message, "")
    return b"".join(writer.parts)


def decode(definition: Definition, data: bytes) -> dict[str, Any]:
    """The message as JSON has it. Raises `MessageError` where the bytes do not fit the definition."""
    try:
        message, at = _get(definition, Field("", definition.kind, None), data, 0)
    except struct.error as error:
        raise MessageError(f"{definition.kind}: the message of {len(data)} bytes is cut short") from error
    if at != len(data):
        raise MessageError(f"{definition.kind}: the message has {len(data)} bytes, its definition {at}")
    assert isinstance(message, dict)
    return message


class _Writer:
    def __init__(self, definition: Definition, *, partial: bool) -> None:
        self.parts: list[bytes] = []
        self._definition = definition
        self._partial = partial

    def put(self, field: Field, value: Any, path: str) -> None:
        if field.length is not None:
            self._array(field, value, path)
        elif field.kind in LETTERS:
            self.parts.append(_number(field.kind, value, path))
        elif field.kind == STRING:
            text = _text(value, path)
            self.parts.append(_LENGTH.pack(len(text)) + text)
        else:
            self._message(field.kind, value, path)

    def _message(self, kind: str, value: Any, path: str) -> None:
        fields = self._definition.fields(kind)
        if not isinstance(value, dict):
            raise _wrong(path, value, f"an object of {', '.join(f.name for f in fields) or 'no fields'}")
        if kind in (TIME, DURATION):
            value = _time(value, path)
        names = {field.name for field in fields}
        unknown = sorted(str(name) for name in value.keys() - names)
        if unknown:
            raise MessageError(f"{_join(path, unknown[0])}: {kind} has no such field")
        for field in fields:
            below = _join(path, field.name)
            if field.name in value:
                self.put(field, value[field.name], below)
            elif self._partial or (kind == HEADER_TYPE and field.name == "seq"):
                self.put(field, _zero(field), below)
            else:
                raise MessageError(f"{below}: is missing")

    def _array(self, field: Field, value: Any, path: str) -> None:
        element = Field(field.name, field.kind, None)
        if value is _ZEROS:
            value = [_zero(element)] * (field.length or 0)
        if not isinstance(value, list) or len(value) > _MAX_ELEMENTS:
            raise _wrong(path, value, f"a list of up to {_MAX_ELEMENTS}")
        if field.length == VARIABLE:
            self.parts.append(_LENGTH.pack(len(value)))
        elif len(value) != field.length:
            raise MessageError(f"{path}: has {len(value)} elements, and must have {field.length}")
        for i, item in enumerate(value):
            self.put(element, item, f"{path}.{i}")


_ZEROS = object()


def _zero(field: Field) -> Any:
    if field.length is not None:
        return [] if field.length == VARIABLE else _ZEROS
    if field.kind == "bool":
        return False
    if field.kind in LETTERS:
        return 0
    return "" if field.kind == STRING else {}


def _number(kind: str, value: Any, path: str) -> bytes:
    letter = LETTERS[kind]
    if letter == "?":
        if type(value) is not bool:
            raise _wrong(path, value, "true or false")
    elif letter in ("f", "d"):
        if type(value) not in (int, float):
            raise _wrong(path, value, "a number")
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise _wrong(path, value, f"a number that fits in {kind}")
    else:
        # A browser writes 1 for 1.0 and cannot tell; what is whole may be an integer.
        if type(value) is float and value.is_integer():
            value = int(value)
        if type(value) is not int:
            raise _wrong(path, value, "an integer")
    try:
        return struct.pack(f"<{letter}", value)
    except (struct.error, OverflowError) as error:
        raise _wrong(path, value, f"a number that fits in {kind}") from error


def _time(value: Mapping[str, Any], path: str) -> Mapping[str, Any]:
    """A time or duration under the names that the definition has."""
    found = {_SPELLINGS.get(name, name): each for name, each in value.items()}
    if len(found) != len(value):
        raise MessageError(f"{path}: has both spellings of a field, {', '.join(value)}")
    nanosec = found.get("nanosec", 0)
    if isinstance(nanosec, (int, float)) and not 0 <= nanosec <= _MAX_NANOSEC:
        raise _wrong(_join(path, "nanosec"), nanosec, f"an integer from 0 to {_MAX_NANOSEC}")
    return found


def _text(value: Any, path: str) -> bytes:
    if not isinstance(value, str):
        raise _wrong(path, value, "a text")
    try:
        return value.encode()
    except UnicodeEncodeError as error:
        raise _wrong(path, value, "a text of Unicode") from error


def _wrong(path: str, value: Any, allowed: str) -> MessageError:
    shown = repr(value) if not isinstance(value, (dict, list)) else type(value).__name__
    return MessageError(f"{path or 'the message'}: found {shown[:60]}; allowed is {allowed}")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _get(definition: Definition, field: Field, data: bytes, at: int) -> tuple[Any, int]:
    if field.length is not None:
        n = field.length
        if n == VARIABLE:
            (n,) = _LENGTH.unpack_from(data, at)
            at += 4
        if n > _MAX_ELEMENTS:
            raise MessageError(f"{field.name}: has {n} elements")
        out = []
        element = Field(field.name, field.kind, None)
        for _ in range(n):
            item, at = _get(definition, element, data, at)
            out.append(item)
        return out, at
    if field.kind in LETTERS:
        reader = struct.Struct(f"<{LETTERS[field.kind]}")
        return reader.unpack_from(data, at)[0], at + reader.size
    if field.kind == STRING:
        (n,) = _LENGTH.unpack_from(data, at)
        if at + 4 + n > len(data):
            raise struct.error
        return data[at + 4 : at + 4 + n].decode("utf-8", "replace"), at + 4 + n
    message = {}
    for nested in definition.fields(field.kind):
        message[nested.name], at = _get(definition, nested, data, at)
    return message, at
