"""Parses message definitions of ROS 1 and ROS 2: the fields of a message, in the wire's order.

A ROS 1 publisher sends the text in its connection header, and a bag of either keeps it: the message's own
definition, then each nested type's after a line of ``=`` and ``MSG: package/Type``. The form of the type's
name says which ROS it is: ``sensor_msgs/Imu`` is ROS 1, ``sensor_msgs/msg/Imu`` is ROS 2. Nested types have
the short form in both, so `HEADER_TYPE`, `TIME` and `DURATION` mean the same in both.
"""

from __future__ import annotations

import hashlib
import re
from typing import Container, Iterator, NamedTuple, Tuple

from iort_contract.limits import MessageError

# Builtin type -> its letter in `struct`. A char is an unsigned byte, and ROS 2's ``byte`` becomes one.
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
STRING, WSTRING, TIME, DURATION = "string", "wstring", "time", "duration"
TEXTS = (STRING, WSTRING)
HEADER_TYPE = "std_msgs/Header"
VARIABLE = -1
# The line before each nested type.
RULE = "=" * 80

_SEPARATOR = re.compile(r"^={20,}\s*$", re.MULTILINE)
_LINE = re.compile(r"([A-Za-z][\w/]*)(?:\[(\d{0,12})\])?\s+([A-Za-z]\w*)\s*(=?)", re.ASCII)
# ROS 2 has bounds, and defaults after the name.
_ROS2_LINE = re.compile(
    r"([A-Za-z][\w/]*)(?:<=(\d{1,12}))?(?:\[(<=)?(\d{0,12})\])?\s+([A-Za-z]\w*)(?:\s*(=)|\s+\S|$)", re.ASCII
)
# rosidl gives an empty message this field, so that it has a byte; it is no field of ours.
_FILLER = "structure_needs_at_least_one_member"
# Limits of nesting and of fields, beyond all messages in use.
_MAX_DEPTH, _MAX_TYPES, _MAX_ARRAY = 32, 256, 2**24


class Field(NamedTuple):
    """A field: ``length`` is None for a single value, `VARIABLE`, or the length of a fixed array.

    ROS 2 bounds texts to ``longest`` characters, and arrays of variable length to ``most`` elements.
    """

    name: str
    kind: str
    length: int | None
    most: int | None = None
    longest: int | None = None

    def __str__(self) -> str:
        """The field's line in a definition."""
        longest = "" if self.longest is None else f"<={self.longest}"
        most = "" if self.most is None else f"<={self.most}"
        length = "" if self.length is None else f"[{most}]" if self.length == VARIABLE else f"[{self.length}]"
        return f"{self.kind}{longest}{length} {self.name}"

    def element(self) -> Field:
        """An element of an array."""
        return Field(self.name, self.kind, None, None, self.longest)


Fields = Tuple[Field, ...]
# Times are nested messages.
TIMES = {
    TIME: (Field("sec", "uint32", None), Field("nanosec", "uint32", None)),
    DURATION: (Field("sec", "int32", None), Field("nanosec", "int32", None)),
}
_ROS2_TIME = (Field("sec", "int32", None), Field("nanosec", "uint32", None))
_ROS2_TIMES = {"builtin_interfaces/Time": TIME, "builtin_interfaces/Duration": DURATION}


def is_ros2(kind: str) -> bool:
    """Whether a type's name has the form of ROS 2: ``package/msg/Type``."""
    return kind.count("/") == 2


def short_kind(kind: str) -> str:
    """The name that a type has in both: ``package/Type``."""
    return f"{kind[: kind.index('/')]}{kind[kind.rindex('/') :]}" if is_ros2(kind) else kind


class Definition(NamedTuple):
    """A message type, under its name in its own ROS, and every type in it, under the short names."""

    kind: str
    types: dict[str, Fields]

    @property
    def ros2(self) -> bool:
        """Whether it is a type of ROS 2."""
        return is_ros2(self.kind)

    def fields(self, kind: str | None = None) -> Fields:
        """The fields of a nested type, or of the message itself."""
        return self.types[kind or short_kind(self.kind)]

    def stamped(self) -> bool:
        """Whether the message begins with a header, as ROS requires."""
        fields = self.fields()
        return bool(fields) and fields[0] == Field("header", HEADER_TYPE, None)


def parse(kind: str, text: str) -> Definition:
    """Parse a definition; raises `MessageError` if it is invalid."""
    definition = Definition(kind, {TIME: _ROS2_TIME, DURATION: _ROS2_TIME} if is_ros2(kind) else {**TIMES})
    sections = dict(_sections(kind, text))
    for name, body in sections.items():
        definition.types[name] = tuple(
            _ros2_fields(name, body, sections) if definition.ros2 else _fields(name, body)
        )
    _check(definition, short_kind(kind), (), set())
    return definition


def layout(definition: Definition) -> str:
    """The definition without comments and constants, in a form that `parse` reads: enough for decoding."""
    written = {kind: name for name, kind in _ROS2_TIMES.items()} if definition.ros2 else {}
    order = [short_kind(definition.kind)]
    for kind in order:
        nested = {field.kind: None for field in definition.types[kind]}
        order += [name for name in nested if "/" in name and name not in order]
    first, *others = (
        "".join(
            f"{field._replace(kind=written.get(field.kind, field.kind))}\n"
            for field in definition.types[kind]
        )
        for kind in order
    )
    return first + "".join(f"{'=' * 80}\nMSG: {kind}\n{body}" for kind, body in zip(order[1:], others))


def md5sum(definition: Definition, text: str) -> str:
    """ROS 1's MD5 of a definition with this text: of the constants, then the fields, a nested type by its
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
        yield short_kind(name), body
    yield short_kind(kind), first


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


def _ros2_fields(kind: str, text: str, known: Container[str]) -> Iterator[Field]:
    package = kind.partition("/")[0]
    for line in text.splitlines():
        stripped = line.split("#", 1)[0].strip()
        match = _ROS2_LINE.match(stripped)
        if match is None:
            if stripped:
                raise MessageError(f"{kind}: the definition has an invalid line {stripped[:60]!r}")
            continue
        base, longest, bounded, length, name, constant = match.groups()
        if constant or name == _FILLER:
            continue
        if (bounded and not length) or (longest and base not in TEXTS):
            raise MessageError(f"{kind}: the definition has an invalid line {stripped[:60]!r}")
        if length and not bounded and int(length) > _MAX_ARRAY:
            raise MessageError(f"{kind}: {name} has {length} elements")
        base = short_kind(base)
        if base == "byte":
            base = "char"
        # Written for ROS 1, unless the package has a type of this name.
        elif base == "Header" and f"{package}/Header" not in known:
            base = HEADER_TYPE
        elif "/" not in base and base not in LETTERS and base not in (*TEXTS, TIME, DURATION):
            base = f"{package}/{base}"
        size = None if length is None else VARIABLE if bounded else int(length or VARIABLE)
        bounds = (int(length) if bounded else None, int(longest) if longest else None)
        yield Field(name, _ROS2_TIMES.get(base, base), size, *bounds)


def _check(definition: Definition, kind: str, within: tuple[str, ...], good: set[str]) -> None:
    if kind in within or len(within) > _MAX_DEPTH:
        raise MessageError(f"{definition.kind}: {kind} contains itself, or is nested too deeply")
    if kind not in definition.types:
        raise MessageError(f"{definition.kind}: the definition of {kind} is missing")
    for nested in {field.kind for field in definition.types[kind]} - good:
        if nested not in LETTERS and nested not in TEXTS:
            _check(definition, nested, (*within, kind), good)
    good.add(kind)
