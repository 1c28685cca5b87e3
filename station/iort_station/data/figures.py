"""Figures of samples: count, min, max, mean, sum, first, last and percentiles, over stretches of time.

Each is computed as DuckDB computes it in one thread from the archive's files in order of time: sums are added
one sample after the other, percentiles interpolated as by ``quantile_cont``. So both give the same bits, and
anybody can recompute a figure. A null counts in none of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Column
from iort_contract.limits import Value
from iort_station.errors import UsageError

# What has a figure of any kind of value; the others are of numbers.
OF_ANY = ("count", "first", "last")
PERCENTILE = re.compile(r"p(\d{1,2}(?:\.\d{1,3})?|100)")
_Numbers = NDArray[np.float64]


def _sum(known: _Numbers) -> float:
    return float(np.add.accumulate(known)[-1])


_OF_NUMBERS: dict[str, Callable[[_Numbers], float]] = {
    "min": lambda known: float(known.min()),
    "max": lambda known: float(known.max()),
    "sum": _sum,
    "mean": lambda known: _sum(known) / len(known),
}
NAMES = (*OF_ANY, *_OF_NUMBERS, "p0 to p100")


def check_figure(name: str) -> str:
    """Return the name of a figure; raises `UsageError`."""
    if name not in OF_ANY and name not in _OF_NUMBERS and not PERCENTILE.fullmatch(name):
        raise UsageError(f"a statistic must be one of {', '.join(NAMES)}, got {name!r}")
    return name


def figure(name: str, field: str, column: Column) -> tuple[Value, int]:
    """A figure of a column, and of how many values it is; None of no value.

    Raises `UsageError` for the mean of texts and the like.
    """
    numbers = column.dtype.kind == "f"
    known: Any = column[~np.isnan(column)] if numbers else [one for one in column.tolist() if one is not None]
    count = len(known)
    if name == "count":
        return count, count
    if name not in OF_ANY and not numbers:
        raise UsageError(f"{field} holds more than numbers: it has only {', '.join(OF_ANY)}, not {name}")
    if not count:
        return None, 0
    if name in {"first", "last"}:
        value = known[0 if name == "first" else -1]
        return float(value) if numbers else value, count
    if name in _OF_NUMBERS:
        with np.errstate(over="ignore"):
            found = _OF_NUMBERS[name](known)
        if not math.isfinite(found):
            raise UsageError(f"the {name} of {field} is beyond the numbers that 64 bits can hold")
        return found, count
    # 99.9 / 100 as DuckDB reads 0.999.
    return _percentile(known, float(Decimal(name[1:]) / 100)), count


def _percentile(known: _Numbers, share: float) -> float:
    place = (len(known) - 1) * share
    low, high = math.floor(place), math.ceil(place)
    ordered = np.partition(known, [low, high])
    between = place - low
    if low == high:
        return float(ordered[low])
    return float(ordered[low] * (1 - between) + ordered[high] * between)


def bins(times_us: NDArray[np.int64], every_us: int) -> Iterator[tuple[int, int]]:
    """The stretches of ``every_us``, counted from the epoch, that have a sample: start and end."""
    for start_us in np.unique(times_us // every_us * every_us).tolist():
        yield start_us, start_us + every_us
