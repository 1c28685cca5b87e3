"""A second of the summary table: a field's statistics are one list, since its name would be half of each.

Outside of the table a second is flat, ``<field>_min`` and so on. Items were once stored so, and some
attributes are still: what `packed_second` leaves as it is, `flat_second` does, too.
"""

from __future__ import annotations

from typing import Any, Mapping

from contract.limits import Value
from contract.tables import EXPIRES_S, OMITTED, SECOND, STATS, TOPIC

_TAKEN = frozenset({TOPIC, SECOND, EXPIRES_S, OMITTED})


def packed_second(flat: Mapping[str, Value]) -> dict[str, Any]:
    """The second with ``[min, mean, max, last]`` under a field's name, and one value where all are that.

    A field of which only the last is known, such as a text, stays ``<field>_last``; one whose name the
    second has for something else stays as it is.
    """
    packed: dict[str, Any] = {}
    for name, value in flat.items():
        field, _, statistic = name.rpartition("_")
        names = [f"{field}_{each}" for each in STATS]
        if field in flat or field in _TAKEN or statistic not in STATS or not flat.keys() >= set(names):
            packed[name] = value
        elif statistic == STATS[0]:
            values = [flat[each] for each in names]
            # The mean and the last lie between least and most.
            packed[field] = values[:1] if flat[f"{field}_min"] == flat[f"{field}_max"] else values
    return packed


def flat_second(packed: Mapping[str, Any]) -> dict[str, Any]:
    """What `packed_second` was given, whatever types the attributes' values were read as."""
    flat: dict[str, Any] = {}
    for name, value in packed.items():
        if isinstance(value, list):
            values = value * len(STATS) if len(value) == 1 else value
            flat.update(zip([f"{name}_{statistic}" for statistic in STATS], values))
        else:
            flat[name] = value
    return flat
