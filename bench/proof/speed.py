"""The processor time that the analysis of a robot-hour takes, and what 1,000 of them take and cost on AWS."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import ceil
from statistics import median

from bench.proof.cars import drive_of
from bench.proof.drives import RATE_HZ, simulated
from iort_analysis.process import analyse
from iort_contract.catalog.derived import F1TENTH
from iort_station.cost.analysing import Function, drive_items
from iort_station.cost.usage import Usage

HOUR_S = 3600.0
_REPEATS = 3


@dataclass(frozen=True)
class Bill:
    """What many robot-hours take on AWS: the time in seconds, and dollars by purpose."""

    seconds: float
    dollars: dict[str, float]


def hour_cpu_s(car: int) -> tuple[float, int]:
    """The processor time in seconds to analyse an hour's drive, the median of some, and its samples."""
    spec = drive_of(car, 0, seconds=HOUR_S)
    streams, _ = simulated(spec)
    spent = []
    for _ in range(_REPEATS):
        began = time.process_time()
        result = analyse(spec.key, streams, F1TENTH, {"mass_kg": spec.vehicle.mass_kg})
        spent.append(time.process_time() - began)
    return median(spent), result.samples


def bill(robot_hours: float, cpu_s: float, drive_s: float, function: Function | None = None) -> Bill:
    """What the analysis of so many robot-hours takes and costs, in drives of ``drive_s`` seconds.

    The samples, of a VESC and as many of poses, are read from the telemetry table.
    """
    f = function or Function()
    drives = ceil(robot_hours * HOUR_S / drive_s)
    billed_s = f.billed_s(cpu_s * drive_s / HOUR_S)
    items = drive_items(Usage(rate_hz=RATE_HZ, streams=2), drives / robot_hours, billed_s, f)
    dollars = {f"{item.service}, {item.what}": robot_hours * item.dollars for item in items}
    return Bill(ceil(drives / f.at_once) * billed_s, dollars)
