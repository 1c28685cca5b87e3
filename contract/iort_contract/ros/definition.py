"""Parses ROS 1 message definitions: the fields of a message, in the wire's order.

A publisher sends the text in its connection header, and a bag keeps it: the message's own definition, then
each nested type's after a line of ``=`` and ``MSG: package/Type``.
"""

from __future__ import annotations

import hashlib
import re
from typing import Iterator, NamedTuple, Tuple

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

    def __str__(self) -> str:
        """The field's line in a definition."""
        length = "" if self.length is None else "[]" if self.length == VARIABLE else f"[{self.length}]"
        return f"{self.kind}{length} {self.name}"


Fields = Tuple[Field, ...]
# Times are nested messages.
TIMES = {
    TIME: (Field("sec", "uint32", None), Field("nanosec", "uint32", None)),
    DURATION: (Field("sec", "int32", None), Field("nanosec", "int32", None)),
}


class Definition(NamedTuple):
    """A message type and every type in it."""

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
    definition = Definition(kind, {**TIMES})
    for name, body in _sections(kind, text):
        definition.types[name] = tuple(_fields(name, body))
    _check(definition, kind, (), set())
    return definition


def layout(definition: Definition) -> str:
    """The definition without comments and constants, in a form that `parse` reads: enough for decoding."""
    order = [definition.kind]
    for kind in order:
        nested = {field.kind: None for field in definition.types[kind]}
        order += [name for name in nested if "/" in name and name not in order]
    first, *others = ("".join(f"{field}\n" for field in definition.types[kind]) for kind in order)
    return first + "".join(f"{'=' * 80}\nMSG: {kind}\n{body}" for kind, body in zip(order[1:], others))


def md5sum(definition: Definition, text: str) -> str:
    """ROS' MD5 of a definition with this text: of the constants, then the fields, a nested type by its
    MD5."""
    done: dict[str, str] = {}
    bodies = dict(_sections(definition.kind, text))

    def md5(kind: str) -> str:
        if kind not in done:
            lines = _constants(bodies[kind])
            for field in definition.types[kind]:
                lines.append(f"{md5(field.kind)} {field.name}" if "/" in field.kind else str(field))
            # The MD5 is ROS' name for a definition, and no secret.
            done[kind] = hashlib.md5("\n".join(lines).encode()).hexdigest()  # noqa: S324 - as above
        return done[kind]

    return md5(definition.kind)


def _constants(body: str) -> list[str]:
    constants = []
    for line in body.splitlines():
        clean = line.split("#", 1)[0].strip()
        if "=" in clean:
            kind, name = clean.split("=", 1)[0].split()
            # A text has no comment behind it: all of the line is the text.
            value = (line if kind == STRING else clean).split("=", 1)[1].strip()
            constants.append(f"{kind} {name}={value}")
    return constants


def _sections(kind: str, text: str) -> Iterator[tuple[str, str]]:
    """Each nested type and its text, then the message's own, which wins over a section of its name."""
    first, *others = _SEPARATOR.split(text)
    if len(others) > _MAX_TYPES:
        raise MessageError(f"{kind}: definition must have at most {_MAX_TYPES} types")
    for section in others:
        head, _, body = section.strip().partition("\n")
        name = head[len("MSG:") :].strip() if head.startswith("MSG:") else ""
        if "/" not in name:
            raise MessageError(f"{kind}: a nested type must begin with MSG: package/Type, got {head[:60]!r}")
        yield name, body
    yield kind, first


def _fields(kind: str, text: str) -> Iterator[Field]:
    package = kind.partition("/")[0]
    for line in text.splitlines():
        stripped = line.split("#", 1)[0].strip()
        match = _LINE.match(stripped)
        if stripped and (match is None or (not match.group(4) and match.end() != len(stripped))):
            raise MessageError(f"{kind}: the definition has an invalid line {stripped[:60]!r}")
        if match is None or match.group(4):
            continue
        base, length, name, _ = match.groups()
        if length and int(length) > _MAX_ARRAY:
            raise MessageError(f"{kind}: {name} has {length} elements")
        if base == "Header":
            base = HEADER_TYPE
        elif "/" not in base and base not in LETTERS and base not in (STRING, TIME, DURATION):
            base = f"{package}/{base}"
        yield Field(name, base, None if length is None else int(length or VARIABLE))


def _check(definition: Definition, kind: str, within: tuple[str, ...], good: set[str]) -> None:
    if kind in within or len(within) > _MAX_DEPTH:
        raise MessageError(f"{definition.kind}: {kind} contains itself, or is nested too deeply")
    if kind not in definition.types:
        raise MessageError(f"{definition.kind}: the definition of {kind} is missing")
    for nested in {field.kind for field in definition.types[kind]} - good:
        if nested not in LETTERS and nested != STRING:
            _check(definition, nested, (*within, kind), good)
    good.add(kind)
