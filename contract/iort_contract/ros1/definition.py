"""Parses ROS 1 message definitions: the fields of a message, in the wire's order.

The text is the one that a publisher sends in its connection header and that a bag keeps: the message's own
definition, then each nested type's after a line of ``=`` and ``MSG: package/Type``.
"""

from __future__ import annotations

import re
from typing import NamedTuple, Tuple

from iort_contract.limits import MessageError

# Builtin type -> its letter in `struct`. A ROS 1 char is an unsigned byte, a byte a signed one.
LETTERS = {
    "bool": "?",
    "int8": "b",
    "byte": "b",
    "uint8": "B",
    "char": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
STRING, TIME, DURATION, HEADER_TYPE = "string", "time", "duration", "std_msgs/Header"
VARIABLE = -1

_SEPARATOR = re.compile(r"^={20,}\s*$", re.MULTILINE)
_LINE = re.compile(r"([A-Za-z][\w/]*)(?:\[(\d*)\])?\s+([A-Za-z]\w*)\s*(=?)", re.ASCII)
# Limits of nesting and of fields, beyond all messages in use.
_MAX_DEPTH, _MAX_TYPES, _MAX_ARRAY = 32, 256, 2**24


class Field(NamedTuple):
    """A field: ``length`` is None for a single value, `VARIABLE`, or the length of a fixed array."""

    name: str
    kind: str
    length: int | None


Fields = Tuple[Field, ...]


class Definition(NamedTuple):
    """A message type and every type in it. Times are nested messages of ``sec`` and ``nanosec``."""

    kind: str
    types: dict[str, Fields]

    def fields(self, kind: str | None = None) -> Fields:
        """The fields of a nested type, or of the message itself."""
        return self.types[kind or self.kind]

    def stamped(self) -> bool:
        """Whether the message begins with a header, as ROS requires."""
        fields = self.fields()
        return bool(fields) and fields[0] == Field("header", HEADER_TYPE, None)


def parse(kind: str, text: str) -> Definition:
    """Parse a definition; raises `MessageError` if it is invalid."""
    first, *others = _SEPARATOR.split(text)
    types: dict[str, Fields] = {
        TIME: (Field("sec", "uint32", None), Field("nanosec", "uint32", None)),
        DURATION: (Field("sec", "int32", None), Field("nanosec", "int32", None)),
    }
    if len(others) > _MAX_TYPES:
        raise MessageError(f"{kind}: definition must have at most {_MAX_TYPES} types")
    for section in others:
        head, _, body = section.strip().partition("\n")
        name = head[len("MSG:") :].strip() if head.startswith("MSG:") else ""
        if "/" not in name:
            raise MessageError(f"{kind}: a nested type must begin with MSG: package/Type, got {head[:60]!r}")
        types[name] = _fields(name, body)
    types[kind] = _fields(kind, first)
    definition = Definition(kind, types)
    _check(definition, kind, (), set())
    return definition


def layout(definition: Definition) -> str:
    """The definition without comments and constants, in a form that `parse` reads: enough for decoding."""
    order = [definition.kind]
    for kind in order:
        nested = {field.kind: None for field in definition.types[kind]}
        order += [name for name in nested if "/" in name and name not in order]
    first, *others = (
        "".join(f"{f.kind}{_brackets(f.length)} {f.name}\n" for f in definition.types[kind]) for kind in order
    )
    rest = (f"{'=' * 80}\nMSG: {kind}\n{text}" for kind, text in zip(order[1:], others))
    return first + "".join(rest)


def _brackets(length: int | None) -> str:
    if length is None:
        return ""
    return "[]" if length == VARIABLE else f"[{length}]"


def _fields(kind: str, text: str) -> Fields:
    package = kind.partition("/")[0]
    found = []
    for line in text.splitlines():
        stripped = line.split("#", 1)[0].strip()
        if not stripped:
            continue
        match = _LINE.match(stripped)
        if match is None or (not match.group(4) and match.end() != len(stripped)):
            raise MessageError(f"{kind}: the definition has an invalid line {stripped[:60]!r}")
        base, length, name, constant = match.groups()
        if constant:
            continue
        if length and int(length) > _MAX_ARRAY:
            raise MessageError(f"{kind}: {name} has {length} elements")
        found.append(
            Field(name, _full_name(base, package), None if length is None else int(length or VARIABLE))
        )
    return tuple(found)


def _full_name(name: str, package: str) -> str:
    if name in LETTERS or name in (STRING, TIME, DURATION):
        return name
    if name == "Header":
        return HEADER_TYPE
    return name if "/" in name else f"{package}/{name}"


def _check(definition: Definition, kind: str, within: tuple[str, ...], good: set[str]) -> None:
    if kind in within or len(within) > _MAX_DEPTH:
        raise MessageError(f"{definition.kind}: {kind} contains itself, or is nested too deeply")
    if kind not in definition.types:
        raise MessageError(f"{definition.kind}: the definition of {kind} is missing")
    for nested in {field.kind for field in definition.types[kind]} - good:
        if nested not in LETTERS and nested != STRING:
            _check(definition, nested, (*within, kind), good)
    good.add(kind)
