"""A second of the summary table: a field's statistics are one list, since its name would be half of each.

Outside of the table a second is flat, ``<field>_min`` and so on. Items were once stored so, and some
attributes are still: what `packed_second` leaves as it is, `flat_second` does, too.
"""

from __future__ import annotations

from typing import Any, Mapping

from contract.limits import Value
from contract.tables import EXPIRES_S, OMITTED, SECOND, STATS, TOPIC

_TAKEN = frozenset({TOPIC, SECOND, EXPIRES_S, OMITTED})
_SUFFIXES = tuple(f"_{statistic}" for statistic in STATS)
_LEAST = _SUFFIXES[0]


def packed_second(flat: Mapping[str, Value]) -> dict[str, Any]:
    """The second with ``[min, mean, max, last]`` under a field's name, and one value where all are that.

    A field of which only the last is known, such as a text, stays ``<field>_last``; one whose name the
    second has for something else stays as it is.
    """
    packed: dict[str, Any] = dict(flat)
    for name, least in flat.items():
        if not name.endswith(_LEAST):
            continue
        field = name[: -len(_LEAST)]
        names = [field + suffix for suffix in _SUFFIXES]
        if field in flat or field in _TAKEN or not all(map(flat.__contains__, names)):
            continue
        values = [packed.pop(each) for each in names]
        # The mean and the last lie between least and most.
        packed[field] = values[:1] if least == values[2] else values
    return packed


def flat_second(packed: Mapping[str, Any]) -> dict[str, Any]:
    """What `packed_second` was given, whatever types the attributes' values were read as."""
    flat: dict[str, Any] = {}
    for name, value in packed.items():
        if isinstance(value, list):
            values = value * len(STATS) if len(value) == 1 else value
            flat.update(zip([name + suffix for suffix in _SUFFIXES], values))
        else:
            flat[name] = value
    return flat
