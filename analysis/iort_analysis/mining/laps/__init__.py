"""Laps, by a gate across the positions, else by the pattern of the drive: time, distance, energy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.laps.laps import Laps, best, find_laps, speed_mps
from iort_analysis.mining.laps.path import Floats
from iort_analysis.results import Mined, Table
from iort_analysis.statistics.intervals import mean_of, sides
from iort_contract.catalog.analysis import LAPS_TABLE, PARAMETERS, PLACES_TABLE
from iort_contract.messages.analysis import Estimate

# What is above zero in every lap; and how sure laps are whose interval says otherwise.
_POSITIVE, _UNSURE = ("lap_best_s", "lap_mean_s", "lap_distance_m"), 0.5
_NAMES = ("lap_best_s", "lap_mean_s", "lap_distance_m", "lap_energy_wh", "lap_energy_wh_per_km")


def mine(drive: Drive) -> Mined:
    """The laps of a drive."""
    found = find_laps(drive)
    if isinstance(found, str):
        return Mined(missing=dict.fromkeys(_NAMES, f"no laps: {found}"))
    estimates, speed = dict(_estimates(found)), speed_mps(drive, found)
    spread = _spread(found)
    # A mean that may as well be below zero is none: such laps differ as much as ways that are no laps.
    unsure = [name for name in _POSITIVE if name in estimates and estimates[name].low <= 0]
    if unsure:
        found = replace(found, confidence=min(found.confidence, _UNSURE))
    missing = {
        name: "needs the car's parameters"
        if name == "lap_distance_m"
        else "needs voltage and current of the battery"
        for name in _NAMES
        if name not in estimates
    }
    missing |= dict.fromkeys(unsure, f"the laps differ too much: {spread}")
    return Mined(
        {name: one for name, one in estimates.items() if name not in unsure},
        missing,
        tables={LAPS_TABLE: _laps_table(found, speed), PLACES_TABLE: _places_table(found, speed)},
    )


def _spread(laps: Laps) -> str:
    times = laps.time_s[laps.complete]
    return f"{len(times)} of {times.min():.1f} s to {times.max():.1f} s"


def _estimates(laps: Laps) -> Iterator[tuple[str, Estimate]]:
    times = laps.time_s[laps.complete]
    either_s = sides() * math.sqrt(2) * laps.jitter_s
    least = float(times.min())
    yield "lap_best_s", Estimate(least, least - either_s, least + either_s, "s")
    for name, values in (
        ("lap_mean_s", laps.time_s),
        ("lap_distance_m", laps.distance_m),
        ("lap_energy_wh", laps.energy_wh),
        ("lap_energy_wh_per_km", _per_km(laps)),
    ):
        known = values[laps.complete]
        known = known[np.isfinite(known)]
        if len(known) >= 2:
            yield name, Estimate(*mean_of(known), PARAMETERS[name].unit)


def _per_km(laps: Laps) -> Floats:
    return laps.energy_wh / laps.distance_m * 1000


def _laps_table(laps: Laps, speed: Floats) -> Table:
    n = len(laps.time_s)
    return {
        "lap": np.arange(1, n + 1),
        "start_us": laps.start_us,
        "time_s": laps.time_s,
        "distance_m": laps.distance_m,
        "energy_wh": laps.energy_wh,
        "energy_wh_per_km": _per_km(laps),
        "mean_speed_mps": laps.distance_m / laps.time_s,
        "top_speed_mps": speed.max(axis=1),
        "complete": laps.complete,
        "best": np.arange(n) == best(laps),
        "method": np.full(n, laps.method, dtype=object),
        "confidence": np.full(n, laps.confidence),
    }


def _places_table(laps: Laps, speed: Floats) -> Table:
    """When each lap passed each place: the difference of two laps is their delta-time."""
    n, places = laps.places.since_s.shape
    return {
        "lap": np.repeat(np.arange(1, n + 1), places),
        "place_m": np.tile(laps.places.place_m, n),
        "since_s": np.round(laps.places.since_s.ravel(), 4),
        "speed_mps": np.round(speed.ravel(), 3),
    }
