"""Simulates and analyses drives on all cores. Results are kept on disk, so that an ended run goes on."""

from __future__ import annotations

import hashlib
import os
import pickle
import random
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import iort_analysis
import iort_contract
from bench.proof.cars import DriveSpec
from bench.proof.drives import digest, simulated
from iort_agent.sources.sim import ALL
from iort_agent.sources.sim.vehicle import VehicleConfig
from iort_analysis.process import analyse
from iort_analysis.results import DriveResult, Measured
from iort_contract.catalog.derived import F1TENTH
from testkit import ROOT

KEPT = ROOT / "build" / "bench-analysis" / "results"
Done = Callable[[], None]
A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Analysed:
    """A drive's result without its tables, the truth, and the processor time that the analysis took."""

    result: DriveResult
    truth: dict[str, float]
    cpu_s: float

    @property
    def measured(self) -> Measured:
        """The drive as one of a baseline."""
        return Measured(self.result.drive, self.result.mined.estimates)


def analysed(spec: DriveSpec) -> Analysed:
    """Simulate and analyse a drive, or take what an earlier run kept."""
    path = KEPT / _version() / f"{digest(spec)}.pickle"
    if path.exists():
        found: Analysed = pickle.loads(path.read_bytes())  # noqa: S301 - this module's own file
        return found
    streams, truth = simulated(spec)
    began = time.process_time()
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
    cpu_s = time.process_time() - began
    truth = {**truth, "seconds": spec.seconds, "motor_sensor": float(spec.fields == ALL)}
    made = Analysed(replace(result, mined=replace(result.mined, tables={})), truth, cpu_s)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{random.getrandbits(64):x}")
    partial.write_bytes(pickle.dumps(made))
    partial.replace(path)
    return made


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
    """The version of the analysis: its code, the contract's, and this module's."""
    folders: Sequence[str] = [*iort_analysis.__path__, *iort_contract.__path__]
    code = [*sorted(path for folder in folders for path in Path(folder).rglob("*.py")), Path(__file__)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in code)).hexdigest()[:16]
