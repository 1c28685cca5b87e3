"""The processor time that the analysis of a robot-hour takes, and what 1,000 of them take and cost on AWS."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

from bench.proof.cars import drive_of
from bench.proof.drives import RATE_HZ
from bench.proof.stored import stored
from iort_analysis.drives.recorded import recorded
from iort_analysis.process import analyse
from iort_contract.catalog.derived import F1TENTH
from iort_station.cost.line_items import READ
from iort_station.cost.prices import PRICES
from iort_station.cost.sizes import sizes_of

HOUR_S = 3600.0
_REPEATS = 3
# A second of poses: docs/how-to/simulated-car.md.
_POSE_ITEM_BYTES = 325
# A function has a whole processor from this memory on ("Configure Lambda function memory").
_MB_PER_CPU = 1769


@dataclass(frozen=True)
class Function:
    """The function that analyses a drive, as stacks/analysis.py deploys it: its memory, how many run at once,
    and the seconds and items that a drive takes besides the analysis, for reading and writing.

    Each is an express workflow of the distributed map.
    """

    memory_mb: int = _MB_PER_CPU
    at_once: int = 40
    drive_s: float = 1.0
    written_units: int = 4
    workflow_mb: int = 64


class Hour(NamedTuple):
    """The processor time in seconds to decode the stored batches of an hour's drive and to analyse them; and
    its samples, of all streams."""

    decode_s: float
    analyse_s: float
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
    """Analyse an hour's drive from its stored batches, some times; the median."""
    spec = drive_of(car, 0, seconds=HOUR_S)
    items, end_us = stored(spec), spec.key.start_us + round(HOUR_S * 1e6)
    hours = []
    for _ in range(_REPEATS):
        began = time.process_time()
        streams = {name: recorded(spec.key, end_us, name, some).block for name, some in items.items()}
        decoded = time.process_time()
        result = analyse(spec.key, streams, F1TENTH, {"mass_kg": spec.vehicle.mass_kg})
        hours.append(Hour(decoded - began, time.process_time() - decoded, result.samples))
    return sorted(hours, key=lambda hour: hour.cpu_s)[_REPEATS // 2]


def bill(robot_hours: float, cpu_s: float, drive_s: float, function: Function | None = None) -> Bill:
    """What the analysis of so many robot-hours takes and costs, in drives of ``drive_s`` seconds.

    A function's share of a processor is its share of the memory that has a whole one. The samples are read
    from the telemetry table.
    """
    f = function or Function()
    drives = ceil(robot_hours * HOUR_S / drive_s)
    billed_s = cpu_s * drive_s / HOUR_S * max(1.0, _MB_PER_CPU / f.memory_mb) + f.drive_s
    units = {
        "Lambda computing": ("compute_arm", drives * billed_s * f.memory_mb / 1024),
        "Lambda invoked": ("invocation", drives),
        "Step Functions, a state for each drive": ("transition", drives),
        "Step Functions, express workflows": ("express_request", drives),
        "Step Functions, their duration": ("express_duration", drives * billed_s * f.workflow_mb / 1024),
        "DynamoDB, samples read": ("read", robot_hours * _read_units_per_hour()),
        "DynamoDB, results written": ("write", drives * f.written_units),
    }
    dollars = {what: count * PRICES[price].each for what, (price, count) in units.items()}
    return Bill(ceil(drives / f.at_once) * billed_s, dollars)


def _read_units_per_hour() -> float:
    """A query's read units of an hour's batches of the VESC and of poses, half a unit for each 4 KB."""
    vesc = sizes_of(RATE_HZ, 1.0).telemetry_item
    return HOUR_S * (vesc + _POSE_ITEM_BYTES) / READ / 2
