"""Encodes a second of the summary table: a field's statistics are one list, which saves repeating its name.

Outside of the table a second is flat, with ``<field>_min`` and so on. Older items are flat in the table too,
and some attributes still are.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, List, Mapping, Union

from iort_contract.limits import Value
from iort_contract.tables import EXPIRES_S, OMITTED, SECOND, STATS, TOPIC

# A field's entry in a second: `STATS`, or one value if all four are equal. A column that is not numeric has
# only its last value.
Statistics = Union[List[Value], Value]
_TAKEN = frozenset({TOPIC, SECOND, EXPIRES_S, OMITTED})
_SUFFIXES = tuple(f"_{statistic}" for statistic in STATS)


def packed_second(counts: Mapping[str, Value], fields: Mapping[str, Statistics]) -> dict[str, Statistics]:
    """The second as stored: its counts, and each field's statistics by its name.

    A single value of a column that is not numeric becomes ``<field>_last``. A field whose name is taken stays
    flat.
    """
    packed: dict[str, Statistics] = dict(fields)
    taken = _TAKEN.union(counts)
    flat: dict[str, Statistics] = dict(counts)
    while odd := [name for name, found in packed.items() if name in taken or type(found) is not list]:
        for name in odd:
            flat.update(_flat(name, packed.pop(name)))
        # A field may have the name of another field's statistic.
        taken |= flat.keys()
    return {**flat, **packed}


def flat_second(packed: Mapping[str, Any]) -> dict[str, Any]:
    """The second with ``<field>_min``, ``_mean``, ``_max`` and ``_last``, for any types of values."""
    flat: dict[str, Any] = {}
    for name, value in packed.items():
        flat.update(_flat(name, value) if isinstance(value, list) else {name: value})
    return flat


def _flat(name: str, statistics: Any) -> dict[str, Any]:
    if not isinstance(statistics, list):
        return {name + _SUFFIXES[-1]: statistics}
    values = statistics * len(STATS) if len(statistics) == 1 else statistics
    return dict(zip(_names(name), values))


@lru_cache(maxsize=4096)
def _names(field: str) -> tuple[str, ...]:
    return tuple([field + suffix for suffix in _SUFFIXES])
