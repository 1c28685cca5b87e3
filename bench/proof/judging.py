"""Judges what the analysis found: faults found, false alarms, and intervals that hold the truth. Pure."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple, TypeVar

import iort_analysis
import iort_contract
from bench.proof.fleet import DriveSpec, cached, digest, simulated, version
from iort_agent.sources.sim import ALL
from iort_agent.sources.sim.vehicle import AIR_KG_PER_M3, G_MPS2, WIND_MPS, VehicleConfig
from iort_analysis.evaluation import evaluate
from iort_analysis.process import analyse
from iort_analysis.results import DriveResult, Measured
from iort_contract.catalog.derived import F1TENTH
from iort_contract.messages.analysis import Finding
from testkit import ROOT

KEPT = ROOT / "build" / "bench-analysis" / "results"
Done = Callable[[], None]
A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Analysed:
    """A drive's result without its tables, and the truth."""

    result: DriveResult
    truth: dict[str, float]

    @property
    def measured(self) -> Measured:
        """The drive as one of a baseline."""
        return Measured(self.result.drive, self.result.mined.estimates)


def analysed(spec: DriveSpec) -> Analysed:
    """Simulate and analyse a drive, or take what an earlier run kept."""
    return cached(KEPT / _version() / digest(spec), lambda: _analyse(spec))


def _analyse(spec: DriveSpec) -> Analysed:
    streams, truth = simulated(spec)
    # What the owner of a car knows: its weight, cells and pole pairs, the rated capacity, and the gain of its
    # vesc.yaml.
    car = spec.vehicle
    known = {
        "mass_kg": car.mass_kg,
        "cells": float(car.cells),
        "capacity_ah": VehicleConfig().capacity_ah,
        "pole_pairs": float(car.pole_pairs),
    }
    result = analyse(spec.key, streams, F1TENTH, known)
    truth = {**truth, "seconds": spec.seconds, "motor_sensor": float(spec.fields == ALL)}
    return Analysed(replace(result, mined=replace(result.mined, tables={})), truth)


def on_all_cores(work: Callable[[A], B], items: Iterable[A], done: Done) -> list[B]:
    """What ``work`` gives for each item, in order; ``done`` is called after each."""
    found: list[B] = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        try:
            for result in pool.map(work, items):
                found.append(result)
                done()
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


@cache
def _version() -> str:
    return version(*iort_analysis.__path__, *iort_contract.__path__, __file__)


# Estimates that are only compared with the car's own earlier drives, in a VESC's units: their interval says
# how well a drive repeats, and a bias that all drives share changes no finding.
INDICATORS = frozenset(
    {
        "inertia_a_per_krpm_s",
        "rolling_current_a",
        "brake_drag_a",
        "voltage_drift_v",
        "motor_current_drift_a",
        "temperature_drift_k",
    }
)
# Estimates whose interval spans what nobody tells: the make and the age of a battery's cells. The simulated
# cars have one make, so they must hold more often than nine times in ten.
SPANNING = frozenset({"battery_drawn_share", "battery_charge_left", "battery_range_left_km"})
Truth = Callable[[Mapping[str, float]], float]


def _same(name: str) -> Truth:
    return lambda truth: truth[name]


def _nothing(_truth: Mapping[str, float]) -> float:
    return 0.0


def _drawn(truth: Mapping[str, float]) -> float:
    return truth["charge"] - truth["charge_left"]


def _moved_kg(truth: Mapping[str, float]) -> float:
    return truth["mass_kg"] + truth["rotating_mass_kg"]


def _friction_n(truth: Mapping[str, float]) -> float:
    return truth["drivetrain_friction_n"] + truth["rolling_resistance"] * truth["mass_kg"] * G_MPS2


def _motor_w_per_k(truth: Mapping[str, float]) -> float:
    return truth["motor_cooling_w_per_k"] * _wind(truth) + truth["motor_to_board_w_per_k"]


def _wind(truth: Mapping[str, float]) -> float:
    return 1 + truth["distance_m"] / truth["seconds"] / WIND_MPS


def _motor_rise(truth: Mapping[str, float]) -> float:
    return 1.5 * truth["motor_resistance_ohm"] / _motor_w_per_k(truth)


def _controller_rise(truth: Mapping[str, float]) -> float:
    """Beside a motor of known temperature; else with what comes from the motor."""
    across = truth["motor_to_board_w_per_k"]
    watts_per_k = truth["board_cooling_w_per_k"] * _wind(truth) + across
    own = 1.5 * truth["fet_resistance_ohm"]
    if truth["motor_sensor"]:
        return own / watts_per_k
    warm = 1.5 * (truth["motor_resistance_now_ohm"] - truth["fet_resistance_ohm"]) / _motor_w_per_k(truth)
    return (own + across * warm) / (watts_per_k - across**2 / _motor_w_per_k(truth))


def _phase_ohm(truth: Mapping[str, float]) -> float:
    """A phase's resistance as a drive's fields give it: at 25 degC with the motor's temperature, else now."""
    if truth["motor_sensor"]:
        return truth["motor_resistance_ohm"] + truth["fet_resistance_ohm"]
    return truth["motor_resistance_now_ohm"]


# By the names of `iort_contract.catalog.analysis.PARAMETERS`; of a healthy car.
TRUTHS: dict[str, Truth] = {
    "battery_resistance_ohm": _same("battery_resistance_ohm"),
    "battery_slow_resistance_ohm": _same("battery_slow_resistance_ohm"),
    "battery_open_voltage_v": _same("open_voltage_v"),
    "battery_voltage_per_ah": _same("voltage_per_ah"),
    "battery_drawn_share": _drawn,
    "battery_charge_left": _same("charge_left"),
    "battery_range_left_km": lambda truth: truth["distance_m"] / 1000 / _drawn(truth) * truth["charge_left"],
    "motor_resistance_25_ohm": _phase_ohm,
    "motor_resistance_ohm": _same("motor_resistance_now_ohm"),
    "motor_flux_linkage_wb": _same("flux_linkage_wb"),
    "motor_inductance_h": _same("motor_inductance_h"),
    "motor_torque_nm_per_a": lambda truth: 1.5 * truth["pole_pairs"] * truth["flux_linkage_wb"],
    "speed_to_erpm_gain": _same("driven_erpm_per_mps"),
    "motor_force_n_per_a": _same("newtons_per_amp"),
    "effective_mass_kg": _moved_kg,
    "rotating_mass_kg": _same("rotating_mass_kg"),
    "friction_n": _friction_n,
    "drag_n_s2_per_m2": lambda truth: 0.5 * AIR_KG_PER_M3 * truth["drag_area_m2"],
    "drivetrain_efficiency": _same("drivetrain_efficiency"),
    "brake_drag_n": _nothing,
    "acceleration_per_a_mps2": lambda truth: truth["newtons_per_amp"] / _moved_kg(truth),
    "friction_per_mass_mps2": lambda truth: _friction_n(truth) / _moved_kg(truth),
    "inertia_a_per_krpm_s": lambda truth: (
        1000
        / truth["speed_to_erpm_gain"]
        * _moved_kg(truth)
        / truth["newtons_per_amp"]
        / truth["drivetrain_efficiency"]
    ),
    "rolling_current_a": lambda truth: (
        _friction_n(truth) / truth["newtons_per_amp"] / truth["drivetrain_efficiency"]
    ),
    "brake_drag_a": _nothing,
    "motor_rise_k_per_a2": _motor_rise,
    "motor_thermal_resistance_k_per_w": lambda truth: _motor_rise(truth) / 1.5 / _phase_ohm(truth),
    "controller_rise_k_per_a2": _controller_rise,
    "controller_thermal_resistance_k_per_w": lambda truth: _controller_rise(truth) / 1.5 / _phase_ohm(truth),
    "voltage_drift_v": _nothing,
    "motor_current_drift_a": _nothing,
    "temperature_drift_k": _nothing,
}


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
