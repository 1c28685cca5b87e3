"""The structure of a message, inferred from its JSON, for a server that does not tell it.

JSON has no types: a number is float64 or int64, and bytes are a text of base64. So the message itself is not
recorded, only its sample.
"""

from __future__ import annotations

from typing import Any, Mapping

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
        types[_KIND] = _fields(message, _KIND, types)
        return Definition(_KIND, types), dict(message), False
    rest = {name: value for name, value in message.items() if name != "header"}
    types[_KIND] = (Field("header", HEADER_TYPE, None), *_fields(rest, _KIND, types))
    stamp = header.get("stamp")
    stamped = isinstance(stamp, dict) and stamp.keys() in _STAMP and set(map(type, stamp.values())) == {int}
    normal = {"stamp": stamp if stamped else {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return Definition(_KIND, types), {"header": normal, **rest}, stamped


def _fields(message: Mapping[str, Any], kind: str, types: dict[str, tuple[Field, ...]]) -> tuple[Field, ...]:
    if kind.count(".") > _MAX_DEPTH:
        raise MessageError("the message is nested too deeply")
    return tuple(_field(name, value, f"{kind}.{name}", types) for name, value in message.items())


def _field(name: str, value: Any, kind: str, types: dict[str, tuple[Field, ...]]) -> Field:
    if not isinstance(value, list):
        return Field(name, _kind(value, kind, types), None)
    kinds = {_kind(item, f"{kind}.{i}", types) for i, item in enumerate(value)}
    if kinds <= {"int64", "float64"}:
        return Field(name, "int64" if kinds == {"int64"} else "float64", VARIABLE)
    # Elements of an array are alike, but for nulls: the first stands for all.
    return Field(name, _kind(value[0], f"{kind}.0", types), VARIABLE)


def _kind(value: Any, kind: str, types: dict[str, tuple[Field, ...]]) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int64" if -(2**63) <= value < 2**63 else "uint64" if 0 < value < 2**64 else "float64"
    if value is None or isinstance(value, float):
        return "float64"
    if isinstance(value, str):
        return STRING
    if not isinstance(value, dict):
        raise MessageError("ROS has no arrays of arrays")
    if value.keys() == {"secs", "nsecs"}:
        return DURATION
    types[kind] = _fields(value, kind, types)
    return kind
