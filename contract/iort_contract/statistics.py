"""What a second of a stream looked like, from the batches that hold its samples. Pure."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import sub
from statistics import mean, median
from typing import TypeGuard

from iort_contract import (
    ABSENT,
    ABSENT_FROM,
    BATCHES,
    GAPS,
    MISSING_BATCHES,
    NONFINITE,
    SAMPLES,
    Batch,
    BatchId,
    Statistics,
    Value,
    absent,
    packed_second,
)

# A step this many times the usual one is a hole: one lost sample makes 2, jitter of a loaded
# Jetson was seen to reach 2.5 on a recorded drive at 50 Hz.
_HOLE = 3.0
_SECOND_US = 1_000_000
_NUMBERS = {int, float}


@dataclass(frozen=True)
class Vehicle:
    """What turns a VESC's numbers into the car's: ``erpm = gain * m/s + offset`` (vesc.yaml)."""

    speed_to_erpm_gain: float
    speed_to_erpm_offset: float = 0.0


def summarize_second(
    second: int, batches: Sequence[Batch], vehicle: Vehicle | None, missing: int = 0
) -> dict[str, Statistics] | None:
    """The summary of one second as it is stored, or None where no sample lies in it; ``missing`` batches
    are known to lack before those that start in it.

    ``batches`` are those of one stream, in order of time: every one that has a sample in the second
    and the one before, from which holes and missing batches are seen. The result has ``n``, ``batches``,
    ``missing_batches``, ``gaps``, ``nonfinite`` and every field, with ``speed_mps`` and ``power_w`` derived
    where the fields and the vehicle's parameters allow (`iort_contract.codec.seconds`); ``absent`` counts
    values of sensors that are not fitted, which are null here.
    """
    start_us, end_us = second * _SECOND_US, (second + 1) * _SECOND_US
    times: list[int] = []
    columns: dict[str, list[Value]] = {}
    nonfinite = touching = 0
    before: list[int] = []
    for batch in batches:
        first, end = bisect_left(batch.times_us, start_us), bisect_left(batch.times_us, end_us)
        if first < end:
            touching += 1
            for name, column in batch.columns.items():
                columns.setdefault(name, [None] * len(times)).extend(column[first:end])
            times.extend(batch.times_us[first:end])
            for column in columns.values():
                column.extend([None] * (len(times) - len(column)))
        if start_us <= batch.t_us < end_us:
            nonfinite += batch.nonfinite
        if first:
            before = [batch.times_us[first - 1]]
    if not times:
        return None
    counts: dict[str, Value] = {
        SAMPLES: len(times),
        BATCHES: touching,
        MISSING_BATCHES: missing,
        GAPS: count_holes([*before, *sorted(times)]),
        NONFINITE: nonfinite,
    }
    without, absences = without_absent(columns)
    if absences:
        counts[ABSENT] = sum(absences.values())
    found = {name: _statistics(column) for name, column in {**without, **derive(without, vehicle)}.items()}
    return packed_second(counts, {name: known for name, known in found.items() if known is not None})


def without_absent(
    columns: Mapping[str, Sequence[Value]],
) -> tuple[Mapping[str, Sequence[Value]], dict[str, int]]:
    """The columns with None for values of sensors that are not fitted, and how many those are by field."""
    found: dict[str, Sequence[Value]] = {}
    absences: dict[str, int] = {}
    for name in columns.keys() & ABSENT_FROM.keys():
        column = columns[name]
        # Of nearly every column one look at its least tells.
        if _are_numbers(column) and not (column and absent(name, min(column))):
            continue
        known = [None if absent(name, value) else value for value in column]
        count = sum(value is None for value in known) - sum(value is None for value in column)
        if count:
            found[name], absences[name] = known, count
    return ({**columns, **found} if found else columns), absences


def missing_before(batch: BatchId, near: Sequence[BatchId]) -> int:
    """How many batches the stream lacks just before one, by their numbers.

    ``near`` are the batches around it in order of time, and at least the one before. Numbers grow by one,
    also over a restart where the spool is durable; one that starts again at a lower number with a new
    ``boot`` is a spool that was lost, of which only the start can be told. Where two runs lie over one
    another in time, as of a recording that was played twice, nothing is told of the first of a run.
    """
    own = [other.seq for other in near if other.boot == batch.boot and other.seq < batch.seq]
    if own:
        return batch.seq - max(own) - 1
    before = [other for other in near if other.boot != batch.boot and other < batch]
    if not before:
        return batch.seq
    if any(other.boot == before[-1].boot and other > batch for other in near):
        return 0
    return batch.seq - before[-1].seq - 1 if batch.seq > before[-1].seq else batch.seq


def count_holes(times_us: Sequence[int]) -> int:
    """Steps between samples over three times the median step; fewer than three steps tell nothing."""
    steps = list(map(sub, times_us[1:], times_us))
    if len(steps) < 3:
        return 0
    limit = _HOLE * median(steps)
    return 0 if max(steps) <= limit else sum(step > limit for step in steps)


def derive(columns: Mapping[str, Sequence[Value]], vehicle: Vehicle | None) -> dict[str, list[Value]]:
    """Speed in m/s (needs the vehicle) and electrical power in W, a value a sample."""
    derived: dict[str, list[Value]] = {}
    speed = columns.get("speed")
    if speed is not None and vehicle is not None:
        gain, offset = vehicle.speed_to_erpm_gain, vehicle.speed_to_erpm_offset
        derived["speed_mps"] = _finite([None if v is None else (v - offset) / gain for v in _numeric(speed)])
    volts, amperes = columns.get("voltage_input"), columns.get("current_input")
    if volts is not None and amperes is not None:
        pairs = zip(_numeric(volts), _numeric(amperes), strict=True)
        derived["power_w"] = _finite([None if v is None or a is None else float(v) * a for v, a in pairs])
    return derived


def _statistics(column: Sequence[Value]) -> Statistics:
    """Least, mean, most and last of a column's numbers, or one value where they are the same; the last
    value of one that holds anything else, None of one that holds nothing."""
    numbers = numbers_of(column)
    if len(numbers) < len(column):
        values = [value for value in column if value is not None]
        if not values or len(numbers) < len(values):
            return values[-1] if values else None
    # In half the time of min and max.
    ordered = sorted(numbers)
    low, high = ordered[0], ordered[-1]
    if low == high:
        return [low]
    # A mean is good to nine digits; the full seventeen would double what the table stores.
    rounded = float(f"{_mean(numbers):.9g}")
    return [low, min(max(rounded, low), high), high, numbers[-1]]


def numbers_of(column: Sequence[Value]) -> Sequence[int | float]:
    """The numbers of a column that may hold other values."""
    return column if _are_numbers(column) else [value for value in column if _is_number(value)]


def _mean(numbers: Sequence[int | float]) -> float:
    try:
        return math.fsum(numbers) / len(numbers)
    except OverflowError:  # the sum is over 1.8e308, which the mean never is
        return float(mean(numbers))


def _numeric(column: Sequence[Value]) -> Sequence[int | float | None]:
    """The column with None for what is no number."""
    return column if _are_numbers(column) else [value if _is_number(value) else None for value in column]


def _finite(values: Sequence[float | None]) -> list[Value]:
    return [None if value is None or not math.isfinite(value) else value for value in values]


def _are_numbers(column: Sequence[Value]) -> TypeGuard[Sequence[int | float]]:
    """Whether all are numbers, which nearly every column's are: one look at their types tells."""
    return set(map(type, column)) <= _NUMBERS


def _is_number(value: Value) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
