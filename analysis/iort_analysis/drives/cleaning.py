"""Cleaning: sensor faults, frozen values and outliers of a stream; each repair is counted by its kind.

All of it is numpy over whole columns: an hour of a motor controller is 180,000 samples of twenty fields.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import FROZEN, GAP, OUTLIER, SAME_TIME, SENSOR_FAULT, Repair, is_vesc
from iort_analysis.samples.blocks import Block, Column
from iort_analysis.statistics.signals import MAD_TO_SIGMA
from iort_contract.catalog.vesc import ABSENT_FROM, MEASURED, VESC_FIELDS

Moving = Callable[[NDArray[np.int64]], NDArray[np.bool_]]

# A pause is longer than this many intervals between samples, and than this time.
_PAUSE_INTERVALS, _PAUSE_US = 10, 500_000
# A value is frozen that stays exactly equal for this long while the car moves, and this many times longer
# than it usually stays.
_FROZEN_US, _FROZEN_TIMES = 5_000_000, 20
# How sure a receiver is of its position is no sensor of the car's: gnss_hAcc, position_covariance.0, hdop.
_ACCURACY = re.compile(
    r"(?:.*[._])?(?:[hvs]_?acc(?:uracy)?|accuracy|[ghpv]?dop|\w*(?:covariance|std_?dev|sigma|uncertainty).*)",
    re.IGNORECASE,
)
# A counter's changes have one sign but for so many, such as a reset.
_RESETS = 0.01
# Hampel: this many scaled median absolute deviations from the median of this many samples on either side.
_HAMPEL, _HALF = 8.0, 7
# An outlier is also further away than this share of the range in which the field nearly always is, and than
# this many times the distance that all but this share of its values keep.
_LEAST_SHARE, _TIMES, _USUAL = 0.15, 4.0, 0.98
# A value is wild that is further from its neighbours than this many times the range in which the field
# mostly is while the car moves. Few of them widen the range of nearly all values, and so hide each other.
_WILD_TIMES, _MOSTLY = 10.0, (0.05, 0.95)
# So many of them after the cleaning are worth a word; half of the values bound them then.
MANY_WILD, _HALF_OF_THEM = 0.01, (0.25, 0.75)
# Enough values for a quantile.
_ENOUGH = 20_000
# Angles jump from pi to -pi.
ANGLES = frozenset({"heading", "yaw"})
_CODES = frozenset(name for name, field in VESC_FIELDS.items() if field.unit in {"enum", "id"})
_FEWEST = 2 * _HALF + 1


def numeric(block: Block) -> Block:
    """The block's numbers and flags as float64; other fields are left out."""
    columns = {name: made for name, column in block.columns.items() if (made := _floats(column)) is not None}
    return Block(block.times_us, columns)


def clean(stream: str, block: Block, moving: Moving) -> tuple[Block, list[Repair]]:
    """A stream of numbers without its faults, and what was repaired.

    What a failed or frozen sensor says becomes NaN, an outlier the median of its neighbours. ``moving`` tells
    at which times the car moves.
    """
    times = block.times_us
    last = np.append(times[1:] != times[:-1], True) if len(times) else np.empty(0, dtype=np.bool_)
    same = np.flatnonzero(~last)
    distinct = block.take(last) if len(same) else block
    sensors = MEASURED if is_vesc(stream, distinct.columns) else frozenset[str]()
    cleaning = _Cleaning(stream, distinct.times_us, moving(distinct.times_us), sensors)
    if len(same):
        cleaning.repairs.append(
            Repair(SAME_TIME, stream, "", int(times[same[0]]), int(times[same[-1]]), len(same))
        )
    cleaning.count_gaps()
    columns = {
        name: column if name in _CODES else cleaning.cleaned(name, column)
        for name, column in distinct.columns.items()
    }
    return Block(distinct.times_us, columns), cleaning.repairs


def pause_us(times: NDArray[np.int64]) -> int:
    """The time between two samples from which on something is missing between them."""
    if len(times) < 2:
        return _PAUSE_US
    return max(_PAUSE_US, round(_PAUSE_INTERVALS * float(np.median(np.diff(times)))))


class _Cleaning:
    """The cleaning of one stream, and its repairs so far."""

    def __init__(
        self, stream: str, times: NDArray[np.int64], moves: NDArray[np.bool_], sensors: frozenset[str]
    ) -> None:
        self._stream, self._times, self._sensors = stream, times, sensors
        self._moves, self._moved = moves, np.append(0, np.cumsum(moves))
        self.repairs: list[Repair] = []

    def count_gaps(self) -> None:
        """Count each pause, and about how many samples are missing in it."""
        steps = np.diff(self._times)
        long = np.flatnonzero(steps > pause_us(self._times))
        usual = max(1.0, float(np.median(steps))) if len(long) else 1.0
        for i in long.tolist():
            missing = round(float(steps[i]) / usual) - 1
            first, last = int(self._times[i]), int(self._times[i + 1])
            self.repairs.append(Repair(GAP, self._stream, "", first, last, missing))

    def cleaned(self, name: str, column: Column) -> Column:
        """A field without faults, frozen values and outliers."""
        return self._without_outliers(name, self._without_frozen(name, self._without_faults(name, column)))

    def _without_faults(self, name: str, column: Column) -> Column:
        """NaN where a thermistor is not fitted or its wire is broken: it reads far below zero."""
        limit = ABSENT_FROM.get(name)
        if limit is None:
            return column
        with np.errstate(invalid="ignore"):
            bad = column <= limit
        # Drivers leave a temperature that they do not read at 0.
        bad |= bool((column == 0).all())
        return self._nulled(SENSOR_FAULT, name, column, bad)

    def _without_frozen(self, name: str, column: Column) -> Column:
        """NaN where a sensor's value stays exactly equal for far longer than it usually does while the car
        moves."""
        if name not in self._sensors and (
            (self._sensors and name in VESC_FIELDS) or _ACCURACY.fullmatch(name) or _counts(column)
        ):
            return column
        times = self._times
        changes = np.flatnonzero(column[1:] != column[:-1]) + 1
        # A field that hardly changes has no usual time to stay.
        if len(changes) < 2 * _FROZEN_TIMES:
            return column
        starts, ends = np.append(0, changes), np.append(changes, len(column))
        lasted = times[ends - 1] - times[starts]
        long = lasted >= _FROZEN_US
        if not long.any():
            return column
        in_motion = self._moved[ends] - self._moved[starts] >= 0.9 * (ends - starts)
        usual = float(np.quantile(lasted[in_motion & ~long], 0.95)) if (in_motion & ~long).any() else np.inf
        frozen = long & in_motion & (lasted >= _FROZEN_TIMES * max(usual, 1.0)) & ~np.isnan(column[starts])
        if name not in self._sensors:
            # A set point comes back to its values, and rests there; a sensor's noise does not.
            values, times_there = np.unique(column[starts], return_counts=True)
            frozen &= times_there[np.searchsorted(values, column[starts])] == 1
        for start, end in zip(starts[frozen].tolist(), ends[frozen].tolist(), strict=True):
            self._repaired(FROZEN, name, np.array([start, end - 1]), end - start)
        return np.where(np.repeat(frozen, ends - starts), np.nan, column) if frozen.any() else column

    def _without_outliers(self, name: str, column: Column) -> Column:
        """Hampel's filter: single values far from their neighbours become the neighbours' median.

        The median of five finds the few candidates quickly; their wider neighbourhood then decides.
        """
        if name in ANGLES or len(column) < _FEWEST:
            return column
        away = np.abs(column - _median_of_five(column))
        low, high = _quantiles(column, [0.01, 0.99])
        least = max(_TIMES * _quantiles(away, [_USUAL])[0], _LEAST_SHARE * (high - low))
        least = min(least, _WILD_TIMES * _width(column[self._moves], _MOSTLY) or least)
        with np.errstate(invalid="ignore"):
            candidates = np.flatnonzero(away > least)
        if not len(candidates) or not least:
            return column
        places = np.clip(candidates[:, None] + np.arange(-_HALF, _HALF + 1), 0, len(column) - 1)
        around = column[places]
        middle = np.median(around, axis=1)
        spread = MAD_TO_SIGMA * np.median(np.abs(around - middle[:, None]), axis=1)
        # Where the neighbours themselves spread, nothing is far from them; near NaN nothing is known.
        with np.errstate(invalid="ignore"):
            far = np.abs(column[candidates] - middle) > np.maximum(_HAMPEL * spread, least)
        found = candidates[far]
        if not len(found):
            return column
        self._repaired(OUTLIER, name, found, len(found))
        made: Column = column.copy()
        made[found] = middle[far]
        return made

    def _nulled(self, kind: str, name: str, column: Column, bad: NDArray[np.bool_]) -> Column:
        found = np.flatnonzero(bad)
        if not len(found):
            return column
        self._repaired(kind, name, found, len(found))
        return np.where(bad, np.nan, column)

    def _repaired(self, kind: str, name: str, places: NDArray[np.intp], samples: int) -> None:
        first, last = int(self._times[places[0]]), int(self._times[places[-1]])
        self.repairs.append(Repair(kind, self._stream, name, first, last, samples))


def _counts(column: Column) -> bool:
    """Whether a field only grows, or only falls."""
    steps = np.diff(column[~np.isnan(column)])
    falls, rises = np.count_nonzero(steps < 0), np.count_nonzero(steps > 0)
    return bool(min(falls, rises) <= _RESETS * max(falls, rises))


def _floats(column: Column) -> Column | None:
    if column.dtype.kind in "fb":
        return column.astype(np.float64)
    kinds = set(map(type, column.tolist()))
    if not kinds <= {int, float, bool, type(None)} or kinds == {type(None)}:
        return None
    return np.array([np.nan if value is None else float(value) for value in column.tolist()])


def _quantiles(column: Column, shares: list[float]) -> list[float]:
    known = column[:: max(1, len(column) // _ENOUGH)]
    known = known[~np.isnan(known)]
    found: list[float] = np.quantile(known, shares).tolist() if len(known) else [0.0] * len(shares)
    return found


def _width(column: Column, shares: tuple[float, float]) -> float:
    """The range of so much of the values."""
    low, high = _quantiles(column, list(shares))
    return high - low


def wild_share(column: Column, moves: NDArray[np.bool_]) -> float:
    """The share of values, single ones, that are far from their neighbours, of a field that was cleaned."""
    width = _width(column[moves], _HALF_OF_THEM)
    if len(column) < _FEWEST or not width:
        return 0.0
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.abs(column - _median_of_five(column)) > _WILD_TIMES * width))


def _median_of_five(column: Column) -> Column:
    """The running median of five samples; NaN near NaN and at both ends."""
    made = np.full(len(column), np.nan)
    a, b, c, d, e = (column[i : len(column) - 4 + i] for i in range(5))
    low = np.maximum(np.minimum(a, b), np.minimum(d, e))
    high = np.minimum(np.maximum(a, b), np.maximum(d, e))
    made[2:-2] = np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), c))
    return made
