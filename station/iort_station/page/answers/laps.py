"""Answers to the live page about laps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np

from iort_analysis.errors import AnalysisError
from iort_analysis.mining.laps.compare import compare
from iort_analysis.results import Mined
from iort_analysis.samples.blocks import Column
from iort_contract.catalog.analysis.parameters import LAPS_TABLE, PLACES_TABLE
from iort_contract.messages.analysis.insights import DeltaAnswer, LapsAnswer
from iort_contract.messages.page import Answer
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.data.analysis.laps import laps_within
from iort_station.errors import StationError
from iort_station.page.answers.insights import estimate
from iort_station.page.answers.parameters import text, whole

# An hour of a VESC at 100 Hz and of its pose.
_MOST_VALUES = 10_000_000
# A viewer compares several laps of a drive, whose samples are read once.
_KEPT = 8


def answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """The answers about laps, by their names."""

    @lru_cache(_KEPT)
    def found(robot: str, start_us: int, end_us: int) -> Mined:
        return laps_within(cloud, robot, start_us, end_us, most=_MOST_VALUES)

    def of(asked: Mapping[str, str]) -> Mined:
        start_us, end_us = (whole(asked, name, 0, 2**53) for name in ("from_us", "to_us"))
        return found(check_robot(text(asked, "robot")), start_us, end_us)

    return {
        "laps": lambda asked: _laps(of(asked)),
        "delta": lambda asked: _delta(
            of(asked), whole(asked, "one", 1, 10**6), whole(asked, "other", 1, 10**6)
        ),
    }


def _laps(mined: Mined) -> LapsAnswer:
    table = mined.tables.get(LAPS_TABLE)
    estimates = {name: estimate(one) for name, one in mined.estimates.items()}
    if table is None:
        reason = next(iter(mined.missing.values()), "no laps")
        return {"laps": [], "method": "", "confidence": 0.0, "reason": reason, "estimates": estimates}
    numbers = {name: _known(column) for name, column in table.items() if column.dtype.kind == "f"}
    return {
        "laps": [
            {
                "lap": int(table["lap"][i]),
                "from_us": int(start_us),
                "to_us": int(start_us) + round(float(table["time_s"][i]) * 1e6),
                "time_s": float(table["time_s"][i]),
                "distance_m": numbers["distance_m"][i],
                "energy_wh": numbers["energy_wh"][i],
                "energy_wh_per_km": numbers["energy_wh_per_km"][i],
                "mean_speed_mps": numbers["mean_speed_mps"][i],
                "top_speed_mps": numbers["top_speed_mps"][i],
                "complete": bool(table["complete"][i]),
                "best": bool(table["best"][i]),
            }
            for i, start_us in enumerate(table["start_us"])
        ],
        "method": str(table["method"][0]),
        "confidence": float(table["confidence"][0]),
        "reason": "",
        "estimates": estimates,
    }


def _delta(mined: Mined, one: int, other: int) -> DeltaAnswer:
    if PLACES_TABLE not in mined.tables:
        raise StationError(next(iter(mined.missing.values()), "no laps"))
    try:
        found = compare(mined.tables[PLACES_TABLE], one, other)
    except AnalysisError as error:
        raise StationError(str(error)) from error
    places = found["place_m"]
    in_metres = bool(np.isfinite(places).all())
    return {
        "places": (places if in_metres else np.linspace(0, 100, len(places))).tolist(),
        "unit": "m" if in_metres else "%",
        "delta_s": found["delta_s"].tolist(),
        "one_mps": _known(found["one_mps"]),
        "other_mps": _known(found["other_mps"]),
    }


def _known(column: Column) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in column]
