"""A ROS message as one flat sample: field path -> value.

Nested messages flatten to dotted paths and arrays to indexes: ``pose.position.x``, ``covariance.0``.
The header and a type's constants are left out. A message that is a header and exactly one nested
message (VescStateStamped, PoseStamped) gives that message's fields without a prefix: the stamp is the
sample's time, and what is left is the thing itself. With ``large``, a ``uint8[]`` stays the bytes that it is,
for `iort_agent.lanes.attachment` to take.
"""

from __future__ import annotations

from typing import Any, Callable, Optional, Sequence

from iort_agent.errors import SourceError
from iort_contract import MAX_FIELDS

# The names of a message's fields, without constants; None for what is not a message.
FieldsOf = Callable[[Any], Optional[Sequence[str]]]

HEADER = "header"


def flatten(message: Any, fields_of: FieldsOf, *, large: bool = False) -> dict[str, Any]:
    """The sample in a message: values, and bytes with ``large``.

    Raises `SourceError` where it has more fields than a sample may.
    """
    names = fields_of(message) or ()
    body = [name for name in names if name != HEADER]
    if len(body) == 1 and len(names) == 2:
        inner = getattr(message, body[0])
        inner_names = fields_of(inner)
        if inner_names is not None:
            message, body = inner, [name for name in inner_names if name != HEADER]
    flat: dict[str, Any] = {}
    for name in body:
        _put(flat, name, getattr(message, name), fields_of, large)
    return flat


def _put(flat: dict[str, Any], path: str, value: Any, fields_of: FieldsOf, large: bool) -> None:  # noqa: FBT001 - passed on
    if type(value) in (float, int, bool, str):
        flat[path] = value
        return
    names = fields_of(value)
    if names is not None:
        for name in names:
            if name != HEADER:
                _put(flat, f"{path}.{name}", getattr(value, name), fields_of, large)
        return
    if large and str(getattr(value, "dtype", "")) == "uint8":
        flat[path] = value.tobytes()
        return
    # numpy's arrays and numbers give plain Python values this way.
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, (list, tuple, bytes, bytearray)):
        if len(flat) + len(plain) > MAX_FIELDS:
            raise SourceError(
                f"field {path} has {len(plain)} elements; a sample may have {MAX_FIELDS} fields"
            )
        for i, item in enumerate(plain):
            _put(flat, f"{path}.{i}", item, fields_of, large)
    else:
        flat[path] = plain
