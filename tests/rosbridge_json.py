"""Converts messages to JSON, as rosbridge_suite 0.11.17 does."""

from __future__ import annotations

import base64
import math
from typing import Any

from iort_contract.ros.definition import DURATION, LETTERS, STRING, TIME, Definition, Field


def as_rosbridge(
    definition: Definition, value: Any, field: Field | None = None, *, ros2: bool = False
) -> Any:
    """Convert a message as rosbridge's message_conversion.py does; bytes are its `uint8[]`."""
    field = field or Field("", definition.kind, None)
    if field.length is not None and field.kind in ("uint8", "char"):
        return base64.standard_b64encode(bytes(value)).decode("ascii")
    if field.length is not None:
        one = Field(field.name, field.kind, None)
        return [as_rosbridge(definition, item, one, ros2=ros2) for item in value]
    if field.kind in ("float32", "float64"):
        return value if math.isfinite(value) else None
    if field.kind in (TIME, DURATION):
        names = ("sec", "nanosec") if ros2 else ("secs", "nsecs")
        return {names[0]: value["sec"], names[1]: value["nanosec"]}
    if field.kind in LETTERS or field.kind == STRING:
        return value
    return {
        inner.name: as_rosbridge(definition, value[inner.name], inner, ros2=ros2)
        for inner in definition.fields(field.kind)
        if inner.name in value
    }
