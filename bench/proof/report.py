"""The report's sections about the analysis: tables, a picture, and the figures that have a target."""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.proof.fleet import RATE_HZ, Plan, drive_of, stored
from bench.proof.judging import INDICATORS, RIGHT, SPANNING, Case, Coverage, Detected, Judged
from bench.report import Section
from iort_agent.sources.sim.faults import KINDS, STRENGTHS
from iort_analysis.drives.stretches import recorded
from iort_analysis.process import analyse
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.derived import F1TENTH
from iort_contract.codec import DICTIONARY
from iort_station.cost.model import DRIVE_S, DRIVES_AT_ONCE, drive_items
from iort_station.cost.prices import PRICES
from iort_station.cost.usage import Usage
from testkit.waiting import InstrumentError


def columns(items: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[np.float64]]:
    """The columns of stored items whose fields are the same, in this order."""
    parts: dict[str, list[NDArray[np.float64]]] = {}
    for item in items:
        deflated = base64.b64decode(item["samples"]["S"])
        fields = json.loads(zlib.decompressobj(zdict=DICTIONARY).decompress(deflated))["fields"]
        for name, (decimals, *steps) in fields.items():
            parts.setdefault(name, []).append(np.cumsum(steps) / 10**decimals)
    return {name: np.concatenate(some) for name, some in parts.items()}


HOUR_S = 3600.0
_REPEATS = 3


class Hour(NamedTuple):
    """The processor time in seconds to decode the stored batches of an hour's drive and to analyse them; that
    of the floor, which only decodes them (`bench.proof.report`); and the samples of all streams."""

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
    billed_s = DRIVE_S + cpu_s * drive_s / HOUR_S
    items = drive_items(Usage(rate_hz=RATE_HZ, streams=2), drives / robot_hours, billed_s)
    dollars = {f"{item.service}, {PRICES[item.price].unit}": robot_hours * item.dollars for item in items}
    return Bill(ceil(drives / DRIVES_AT_ONCE) * billed_s, dollars)


_TARGETS = {"middle": 80.0, "strong": 95.0}
_FALSE_ALARMS_HOURS, _COVERED, _LEAST_SPANNED = 24.0, (85.0, 95.0), 90.0
# Other kinds of finding are named that come with this share of the strong faults.
_OFTEN = 0.2


def detected(plan: Plan, counts: Mapping[Case, Detected]) -> Section:
    """The faults found, by kind and strength."""
    section, rows = Section("detection", "Faults found in the simulated fleet"), []
    for kind, what in KINDS.items():
        strong = counts[kind, "strong"]
        others = [f"{name} {n}" for name, n in strong.others.most_common() if n >= _OFTEN * strong.drives]
        cells = []
        for strength in STRENGTHS:
            case = counts[kind, strength]
            percent, target = 100 * case.found / case.drives, _TARGETS.get(strength)
            cells.append(_marked(f"{percent:.0f} %", good=target is None or percent >= target))
        right = ", ".join(sorted(RIGHT[kind]))
        of_kind = dict.fromkeys(what.by_field.values() or [what.strengths])
        strengths = "; ".join(", ".join(f"{one:g}" for one in three) for three in of_kind)
        rows.append([kind, right, strengths, what.unit, *cells, ", ".join(others)])
    head = ["fault", "right finding", "weak, middle, strong", "unit", *STRENGTHS]
    title = (
        f"{plan.cars} cars, each with {plan.baseline} healthy drives of {plan.seconds / 60:g} minutes before"
    )
    section.table(title, [*head, "other findings of the strong"], rows)
    for strength in STRENGTHS:
        cases = [counts[kind, strength] for kind in KINDS]
        share = 100 * sum(case.found for case in cases) / sum(case.drives for case in cases)
        settings: dict[str, Any] = {"unit": "%", "at_least": True, "tolerance": 1.05}
        section.ratio(f"faults found, {strength}", round(share, 1), _TARGETS.get(strength), **settings)
    section.notes.append(
        "A fault counts as found if its first drive has a finding of the right kind. A sensor's fault is in "
        "another field from car to car."
    )
    section.raw = {
        f"{kind} {strength}": {"drives": case.drives, "found": case.found, "others": dict(case.others)}
        for (kind, strength), case in counts.items()
    }
    return section


def alarms(plan: Plan, judged: Sequence[Judged]) -> Section:
    """The findings about healthy cars."""
    section = Section("false alarms", "False alarms of healthy cars")
    findings = [finding for car in judged for finding in car.false_alarms]
    section.table(
        f"{plan.healthy_hours:.1f} driving hours of {plan.cars} healthy cars: {len(findings)} findings",
        ["robot", "finding", "text"],
        [[one.drive.robot, f"{one.kind} ({one.subject})", one.text] for one in findings],
    )
    often = len(findings) * _FALSE_ALARMS_HOURS / plan.healthy_hours
    section.ratio("false alarms in 24 driving hours", round(often, 2), 1.0, unit="findings", tolerance=2.0)
    section.raw = {"hours": plan.healthy_hours, "findings": [one.id for one in findings]}
    return section


def covered(drives: int, coverages: Mapping[str, Coverage], without: Sequence[str]) -> Section:
    """How often the intervals hold the truth."""
    section = Section("coverage", "Intervals that hold the truth")
    groups: dict[str, dict[str, Coverage]] = {"parameters": {}, "spanning": {}, "indicators": {}}
    for name, coverage in sorted(coverages.items()):
        group = "indicators" if name in INDICATORS else "spanning" if name in SPANNING else "parameters"
        groups[group][name] = coverage
    parameters, spanning, indicators = groups.values()
    tables: dict[str, tuple[Mapping[str, Coverage], Callable[[float], bool]]] = {
        f"90 % intervals of {drives} healthy cars with a drive each": (parameters, _covers),
        "Intervals that span the makes and ages of battery cells, which no owner tells": (
            spanning,
            lambda percent: percent >= _LEAST_SPANNED,
        ),
        "Indicators: only compared with the car's own earlier drives": (indicators, lambda _: True),
    }
    for title, (shown, good) in tables.items():
        rows = [
            [
                name,
                str(coverage.drives),
                _marked(f"{100 * coverage.share:.1f} %", good=good(100 * coverage.share)),
                f"{median(coverage.widths):.2g} {coverage.unit}",
                f"{median(coverage.off):+.2g} {coverage.unit}",
            ]
            for name, coverage in shown.items()
        ]
        section.table(title, ["parameter", "drives", "held", "width, median", "off, median"], rows)
    section.ratio(
        f"parameters of {len(parameters)} whose intervals hold the truth less or more often than 85 to 95 %",
        sum(not _covers(100 * coverage.share) for coverage in parameters.values()),
        0.0,
        unit="parameters",
        tolerance=1.0,
    )
    section.ratio(
        "intervals of a battery's charge and range that hold the truth",
        round(100 * min(coverage.share for coverage in spanning.values()), 1),
        _LEAST_SPANNED,
        unit="%",
        at_least=True,
        tolerance=1.05,
    )
    section.notes.append(
        "Widths and errors are in % of the truth. An indicator's interval says how well a drive repeats; "
        "a bias that all drives share changes no finding."
    )
    if without:
        section.notes.append(f"The simulator has no single truth for {', '.join(without)}.")
    section.raw = {name: {"drives": one.drives, "held": one.held} for name, one in coverages.items()}
    return section


def speed(hour: Hour, robot_hours: float, ours: Bill, floor: Bill) -> Section:
    """The time and the cost of the analysis, beside those of a function that decodes and nothing else."""
    section = Section("speed", "Time and cost of the analysis")
    dollars, least = sum(ours.dollars.values()), sum(floor.dollars.values())
    section.table(
        f"{robot_hours:,.0f} robot-hours on AWS in dollars, by the cost model from the processor time",
        ["", "analysis", "floor"],
        [
            *([what, f"{usd:.3f}", f"{floor.dollars[what]:.3f}"] for what, usd in ours.dollars.items()),
            ["in all", f"{dollars:.3f}", f"{least:.3f}"],
            ["minutes", f"{ours.seconds / 60:.1f}", f"{floor.seconds / 60:.1f}"],
        ],
    )
    name = f"an hour's {hour.samples:,} samples, decoded and analysed: processor / its floor"
    section.ratio(name, hour.cpu_s / hour.floor_s, 3.0)
    name = f"{robot_hours:,.0f} robot-hours on AWS: dollars / the floor's"
    section.ratio(name, dollars / least, 3.0)
    section.notes.append(
        f"Of the hour's processor time {hour.decode_s:.2f} s decode the stored batches, "
        f"{hour.analyse_s:.2f} s clean and mine. The floor decodes the same values in {hour.floor_s:.2f} s: "
        "base64, zlib, JSON and numpy's sums, a batch at a time, without any check. "
        "Dollars and minutes are those of a processor like this one."
    )
    section.raw = {**hour._asdict(), "dollars": ours.dollars, "floor_dollars": floor.dollars}
    return section


def _covers(percent: float) -> bool:
    low, high = _COVERED
    return low <= percent <= high


def _marked(text: str, *, good: bool) -> str:
    return text if good else f"**{text}**"
