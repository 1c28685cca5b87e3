"""The structure of a message, inferred from its JSON, for a server that does not tell it.

JSON has no types: a number is float64 or int64, and bytes are a text of base64. So the message itself is not
recorded, only its sample.
"""

from __future__ import annotations

from typing import Any, Mapping, Sequence

from iort_contract.limits import MessageError
from iort_contract.ros1.definition import (
    DURATION,
    HEADER_TYPE,
    STRING,
    TIME,
    TIMES,
    VARIABLE,
    Definition,
    Field,
)

_KIND = "json/Message"
_STAMP = ({"secs", "nsecs"}, {"sec", "nanosec"})
_MAX_DEPTH = 32


def infer(message: Mapping[str, Any]) -> tuple[Definition, dict[str, Any], bool]:
    """A definition for the message, the message as the definition has it, and whether it has a stamp.

    Raises `MessageError` if no ROS message is like this.
    """
    types = {
        **TIMES,
        HEADER_TYPE: (
            Field("seq", "uint32", None),
            Field("stamp", TIME, None),
            Field("frame_id", STRING, None),
        ),
    }
    header = message.get("header")
    if not isinstance(header, dict):
        types[_KIND] = _fields([message], _KIND, types)
        return Definition(_KIND, types), dict(message), False
    rest = {name: value for name, value in message.items() if name != "header"}
    types[_KIND] = (Field("header", HEADER_TYPE, None), *_fields([rest], _KIND, types))
    stamp = header.get("stamp")
    stamped = isinstance(stamp, dict) and stamp.keys() in _STAMP and set(map(type, stamp.values())) == {int}
    normal = {"stamp": stamp if stamped else {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return Definition(_KIND, types), {"header": normal, **rest}, stamped


def _fields(
    messages: Sequence[Mapping[str, Any]], kind: str, types: dict[str, tuple[Field, ...]]
) -> tuple[Field, ...]:
    """The fields of messages of one type."""
    if kind.count(".") > _MAX_DEPTH:
        raise MessageError("the message is nested too deeply")
    names = messages[0].keys()
    if any(message.keys() != names for message in messages):
        raise MessageError("the elements of an array have different fields")
    return tuple(_field(name, [one[name] for one in messages], f"{kind}.{name}", types) for name in names)


def _field(name: str, values: list[Any], kind: str, types: dict[str, tuple[Field, ...]]) -> Field:
    """A field with these values. In an array of messages it has many, and one may be more telling than the
    first: an array that is not empty, a float among integers."""
    if not all(isinstance(value, list) for value in values):
        return Field(name, _kind(values, kind, types), None)
    return Field(name, _kind([item for value in values for item in value], kind, types), VARIABLE)


def _kind(values: list[Any], kind: str, types: dict[str, tuple[Field, ...]]) -> str:
    found = set(map(type, values))
    if found <= {int} and found:
        least, most = min(values), max(values)
        if least >= -(2**63) and most < 2**63:
            return "int64"
        return "uint64" if least >= 0 and most < 2**64 else "float64"
    if found <= {int, float, type(None)}:
        return "float64"
    if len(found) > 1:
        raise MessageError("the elements of an array have different types")
    if found == {bool}:
        return "bool"
    if found == {str}:
        return STRING
    if found != {dict}:
        raise MessageError("ROS has no arrays of arrays")
    if all(value.keys() == {"secs", "nsecs"} for value in values):
        return DURATION
    types[kind] = _fields(values, kind, types)
    return kind
