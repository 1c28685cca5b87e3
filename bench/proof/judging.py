"""Judges what the analysis found: faults found, false alarms, and intervals that hold the truth. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from bench.proof.analysing import Analysed
from bench.proof.truths import TRUTHS
from iort_analysis.evaluation.evaluate import evaluate
from iort_analysis.results import Measured
from iort_contract.messages.analysis import Finding

# The findings that are right for a fault of the simulator. Another one does not count as having found it.
RIGHT: Mapping[str, frozenset[str]] = {
    "worn_battery": frozenset({"battery_worn"}),
    "added_friction": frozenset({"friction_added"}),
    "flat_tyre": frozenset({"tyre_flat"}),
    "dragging_brake": frozenset({"brake_dragging"}),
    "sensor_stuck": frozenset({"sensor_stuck"}),
    "sensor_drift": frozenset({"sensor_drift"}),
    "cell_dropout": frozenset({"cell_dropout"}),
    "cooling_lost": frozenset({"cooling_lost"}),
    "loose_pinion": frozenset({"pinion_loose"}),
    "motor_resistance": frozenset({"motor_resistance_grown"}),
    "payload": frozenset({"payload_added"}),
    "intermittent_can": frozenset({"can_intermittent"}),
}
Case = tuple[str, str]


@dataclass(frozen=True)
class Car:
    """A car's drives: those of its baseline, the healthy ones after them, and one with each fault."""

    baseline: Sequence[Analysed]
    healthy: Sequence[Analysed]
    faulty: Mapping[Case, Analysed]
    fleet: Sequence[Measured]


@dataclass(frozen=True)
class Judged:
    """The kinds of findings about each of a car's faulty drives, and the findings about its healthy ones."""

    found: Mapping[Case, frozenset[str]]
    false_alarms: Sequence[Finding]


def judge(car: Car) -> Judged:
    """Evaluate as a night would: each faulty drive after the baseline, the healthy ones in their order."""
    before = [one.measured for one in car.baseline]
    found = {
        case: frozenset(finding.kind for finding in evaluate([drive.result], before, car.fleet))
        for case, drive in car.faulty.items()
    }
    alarms: list[Finding] = []
    for drive in car.healthy:
        alarms += evaluate([drive.result], before, car.fleet)
        before = [*before, drive.measured]
    return Judged(found, alarms)


class Detected(NamedTuple):
    """How many of a fault's drives have a right finding, and how often each other kind of finding came."""

    drives: int
    found: int
    others: Counter[str]


def detection(judged: Sequence[Judged]) -> dict[Case, Detected]:
    """What was found of each fault, over all cars."""
    made: dict[Case, Detected] = {}
    for case in judged[0].found:
        kinds = [car.found[case] for car in judged]
        right = RIGHT[case[0]]
        others = Counter(kind for found in kinds for kind in found - right)
        made[case] = Detected(len(kinds), sum(bool(found & right) for found in kinds), others)
    return made


@dataclass
class Coverage:
    """How often a parameter's interval holds the truth, how wide it is, and how far off its value: both in
    ``unit``, % of the truth or the parameter's own where the truth is 0."""

    unit: str
    drives: int = 0
    held: int = 0
    widths: list[float] = field(default_factory=list)
    off: list[float] = field(default_factory=list)

    @property
    def share(self) -> float:
        """The share of the intervals that hold the truth."""
        return self.held / self.drives


def coverage(drives: Sequence[Analysed]) -> dict[str, Coverage]:
    """The coverage of each parameter that has a truth and was estimated at least once."""
    made: dict[str, Coverage] = {}
    for drive in drives:
        for name, estimate in drive.result.mined.estimates.items():
            if name not in TRUTHS:
                continue
            truth, one = TRUTHS[name](drive.truth), made.setdefault(name, Coverage("%"))
            one.drives += 1
            one.held += estimate.low <= truth <= estimate.high
            if not truth:
                one.unit = estimate.unit
            scale = 100 / abs(truth) if truth else 1.0
            one.widths.append((estimate.high - estimate.low) * scale)
            one.off.append((estimate.value - truth) * scale)
    return made
