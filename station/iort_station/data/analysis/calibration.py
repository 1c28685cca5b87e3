"""A robot's calibration: the parameters of its car, over its analysed drives."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from iort_analysis.evaluation.combined import combined
from iort_contract.catalog.analysis.car import GROUPS
from iort_contract.catalog.derived import Vehicle
from iort_contract.messages.analysis.findings import Estimate
from iort_contract.messages.analysis.run import AnalysedDrive

GAIN = "speed_to_erpm_gain"
_NUMBER = re.compile(r"\d[\d.,]*")


class Calibrated(NamedTuple):
    """A parameter over ``drives`` drives."""

    estimate: Estimate
    drives: int


class Calibration(NamedTuple):
    """The parameters that drives gave, and why the drives did not give the others."""

    found: Mapping[str, Calibrated]
    missing: Mapping[str, str]


def calibration(drives: Sequence[AnalysedDrive]) -> Calibration:
    """The car's parameters from drives, the newest first. A state, such as the battery's charge, is the
    newest drive's."""
    found: dict[str, Calibrated] = {}
    missing: dict[str, str] = {}
    for parameter in (one for group in GROUPS.values() for one in group):
        name = parameter.name
        known = [drive.estimates[name] for drive in drives if name in drive.estimates]
        if known:
            used = known[:1] if parameter.state else known
            found[name] = Calibrated(combined(used), len(used))
        elif reasons := [drive.missing[name] for drive in drives if name in drive.missing]:
            missing[name] = _reasons(reasons)
    return Calibration(found, missing)


def _reasons(reasons: Sequence[str]) -> str:
    """The drives' reasons, the most frequent first, each with the number of drives that give it.

    Reasons that differ in their numbers alone are one, with the newest drive's numbers.
    """
    alike: dict[str, list[str]] = {}
    for reason in reasons:
        alike.setdefault(_NUMBER.sub("#", reason), []).append(reason)
    if len(alike) == 1:
        return reasons[0]
    ranked = sorted(alike.values(), key=len, reverse=True)
    return "; ".join(f"{same[0]} ({len(same)} of {len(reasons)} drives)" for same in ranked)


def vesc_yaml(calibrated: Calibration, vehicle: Vehicle | None) -> str:
    """The lines of the car's vesc.yaml; empty if the drives did not tell the gain.

    The offset stays what it is: a ratio of distances does not depend on it.
    """
    gain = calibrated.found.get(GAIN)
    if gain is None:
        return ""
    low, high = (f"{value:.1f}" for value in (gain.estimate.low, gain.estimate.high))
    offset = 0.0 if vehicle is None else vehicle.speed_to_erpm_offset
    return (
        f"{GAIN}: {gain.estimate.value:.1f}  # {low} to {high} {gain.estimate.unit}\n"
        f"speed_to_erpm_offset: {offset:.1f}\n"
    )
