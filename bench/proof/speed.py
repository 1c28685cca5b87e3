"""The processor time of a robot-hour's analysis, beside its floor, and what 1,000 of them take and cost on
AWS."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.floors.decoding import columns
from bench.proof.cars import drive_of
from bench.proof.drives import RATE_HZ
from bench.proof.stored import stored
from iort_analysis.drives.recorded import recorded
from iort_analysis.process import analyse
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_station.cost.model import DRIVES_AT_ONCE, drive_billed_s, drive_items
from iort_station.cost.usage import Usage
from testkit.waiting import InstrumentError

HOUR_S = 3600.0
_REPEATS = 3


class Hour(NamedTuple):
    """The processor time in seconds to decode the stored batches of an hour's drive and to analyse them; that
    of the floor, which only decodes them (`bench.floors.decoding`); and the samples of all streams."""

    decode_s: float
    analyse_s: float
    floor_s: float
    samples: int

    @property
    def cpu_s(self) -> float:
        """All of it."""
        return self.decode_s + self.analyse_s


@dataclass(frozen=True)
class Bill:
    """What many robot-hours take on AWS: the time in seconds, and dollars by purpose."""

    seconds: float
    dollars: dict[str, float]


def hour_cpu_s(car: int) -> Hour:
    """Analyse an hour's drive from its stored batches, in turns with the floor; the median turn."""
    spec = drive_of(car, 0, seconds=HOUR_S)
    items, end_us = stored(spec), spec.key.start_us + round(HOUR_S * 1e6)
    hours = []
    for _ in range(_REPEATS):
        began = time.process_time()
        streams = {name: recorded(spec.key, end_us, name, some).block for name, some in items.items()}
        decoded = time.process_time()
        result = analyse(spec.key, streams, F1TENTH, {"mass_kg": spec.vehicle.mass_kg})
        analysed = time.process_time()
        floor = {name: columns(some) for name, some in items.items()}
        floor_s = time.process_time() - analysed
        _check(streams, floor)
        hours.append(Hour(decoded - began, analysed - decoded, floor_s, result.samples))
    return sorted(hours, key=lambda hour: hour.cpu_s / hour.floor_s)[_REPEATS // 2]


def _check(streams: Mapping[str, Block], floor: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> None:
    """Raise `InstrumentError` if the floor has not decoded what we have."""
    for stream, block in streams.items():
        for name, column in block.columns.items():
            if not np.array_equal(column, floor[stream][name]):
                raise InstrumentError(f"{stream}.{name}: the floor must decode the same values")


def bill(robot_hours: float, cpu_s: float, drive_s: float) -> Bill:
    """What the analysis of so many robot-hours takes and costs, in drives of ``drive_s`` seconds.

    The samples, of a VESC and as many of poses, are read from the telemetry table.
    """
    drives = ceil(robot_hours * HOUR_S / drive_s)
    billed_s = drive_billed_s(cpu_s * drive_s / HOUR_S)
    items = drive_items(Usage(rate_hz=RATE_HZ, streams=2), drives / robot_hours, billed_s)
    dollars = {f"{item.service}, {item.what}": robot_hours * item.dollars for item in items}
    return Bill(ceil(drives / DRIVES_AT_ONCE) * billed_s, dollars)
