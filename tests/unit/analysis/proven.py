"""Drives of the simulated fleet for the miners of the car's parameters, with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

from bench.proof.fleet import drive_of, fault_of, simulated
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import Drive

SECONDS = 240.0


class Proven(NamedTuple):
    """A drive and the truth about its car by name."""

    drive: Drive
    truth: Mapping[str, float]


@cache
def proven(car: int, fault: str = "", strength: str = "strong") -> Proven:
    """A drive of a car; cars with odd numbers report all fields of a VESC."""
    faults = [fault_of(car, fault, strength)] if fault else []
    spec = drive_of(car, 0, faults, seconds=SECONDS)
    streams, truth = simulated(spec, kept=None)
    return Proven(build(spec.key, streams), truth)
