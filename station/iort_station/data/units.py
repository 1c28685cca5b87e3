"""Units of fields, by the type of their messages and by the driver that sent them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.ros_types import ROS_UNITS, TYPE_UNITS
from iort_contract.catalog.streams import CATALOG
from iort_contract.catalog.vesc import LOG_UNITS, VESC, VESC_STREAM
from iort_contract.limits import MessageError
from iort_contract.messages.message_type import MessageType
from iort_contract.ros1.definition import Fields, parse
from iort_contract.tables import STATS

VESC_KIND = "vesc_msgs/VescState"


def unit(stream: str, name: str, *, ros2: bool = False, kind: MessageType | None = None) -> str:
    """The unit of a field or of one of its statistics; empty if unknown.

    ``ros2`` tells that the samples are the ROS 2 driver's; ``kind`` is the type of the stream's messages.
    """
    stem, _, statistic = name.rpartition("_")
    for field in (name, stem) if statistic in STATS else (name,):
        if found := _unit(stream, field, kind, ros2=ros2):
            return found
    return ""


def _unit(stream: str, field: str, kind: MessageType | None, *, ros2: bool) -> str:
    if field in DERIVED:
        return DERIVED[field].unit
    if kind is None and stream in CATALOG and (found := CATALOG[stream].unit(field, ros2=ros2)):
        return found
    if kind is not None and (found := _by_type(kind, field, ros2=ros2)):
        return found
    if stream == VESC_STREAM and (found := VESC.unit(field, ros2=ros2)):
        return found
    if field in LOG_UNITS and (stream == VESC_STREAM if kind is None else kind.kind == VESC_KIND):
        return LOG_UNITS[field]
    # The driver's VescImu has fields of these names in other units.
    if kind is not None and kind.kind.startswith("vesc_msgs/"):
        return ""
    within, _, axis = field.rpartition(".")
    known_as = (of for of in ROS_UNITS if within == of or within.endswith(f".{of}"))
    return next((ROS_UNITS[of] for of in known_as), "") if axis in {"x", "y", "z"} else ""


def _by_type(kind: MessageType, path: str, *, ros2: bool) -> str:
    types = _types(kind.kind, kind.definition)
    body = [field for field in types.get(kind.kind, ()) if field.name != "header"]
    # With a header and one other field, the sample's fields are that field's: see
    # contract/iort_contract/ros1/decode.py.
    starts = [body[0].kind, kind.kind] if len(body) == 1 else [kind.kind]
    return next(filter(None, (_on_the_way(types, start, path, ros2=ros2) for start in starts)), "")


def _on_the_way(types: Mapping[str, Fields], kind: str, path: str, *, ros2: bool) -> str:
    """The unit that a type along the path gives to the next part of the path."""
    for part in path.split("."):
        if part.isdecimal():
            continue
        if kind.startswith(VESC_KIND) and (found := VESC.unit(part, ros2=ros2)):
            return found
        if part in TYPE_UNITS.get(kind, {}):
            return TYPE_UNITS[kind][part]
        kind = next((field.kind for field in types.get(kind, ()) if field.name == part), "")
    return ""


@lru_cache(maxsize=256)
def _types(kind: str, definition: str) -> Mapping[str, Fields]:
    """The fields of a type and of the types inside it; empty for an invalid definition."""
    try:
        return parse(kind, definition).types
    except MessageError:
        return {}
