"""Flattens a ROS message into a sample: field path -> value.

Nested messages give dotted paths and arrays give indexes: ``pose.position.x``, ``covariance.0``. The
header and a type's constants are left out. A message of a header and exactly one nested message
(VescStateStamped, PoseStamped) gives the nested message's fields without a prefix, since the stamp is the
sample's time.

This is the rule of `iort_contract.ros.decode`, for objects of other libraries. Tests compare the decoder
with it.
"""

from __future__ import annotations

from typing import Any, Callable, Mapping, Optional

# Returns a message's fields without its constants; None for a value that is not a message.
Members = Callable[[Any], Optional[Mapping[str, Any]]]

HEADER = "header"


def flatten(message: Any, members: Members) -> dict[str, Any]:
    """Return the sample of a message."""
    fields = dict(members(message) or {})
    if len(fields) == 2 and HEADER in fields:
        (inner,) = (members(value) for name, value in fields.items() if name != HEADER)
        fields = dict(fields if inner is None else inner)
    fields.pop(HEADER, None)
    flat: dict[str, Any] = {}
    for name, value in fields.items():
        _put(flat, name, value, members)
    return flat


def _put(flat: dict[str, Any], path: str, value: Any, members: Members) -> None:
    if type(value) in (float, int, bool, str):
        flat[path] = value
        return
    fields = members(value)
    if fields is not None:
        for name, member in fields.items():
            if name != HEADER:
                _put(flat, f"{path}.{name}", member, members)
        return
    # Converts numpy's arrays and numbers to plain Python values.
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, (list, tuple, bytes, bytearray)):
        for i, item in enumerate(plain):
            _put(flat, f"{path}.{i}", item, members)
    else:
        flat[path] = plain
