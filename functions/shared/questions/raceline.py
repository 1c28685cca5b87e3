"""Raceline: the line of least curvature around a track, and the fastest speeds along it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from functions.shared.questions import parameters
from functions.shared.questions.work import RefusedError
from iort_analysis.errors import AnalysisError
from iort_analysis.raceline.line import least_curvature
from iort_analysis.raceline.reference import reference
from iort_analysis.raceline.speed import Limits, profile
from iort_contract.catalog.questions import CAR_LIMITS, SAG, CarLimit
from iort_contract.checks import shown
from iort_contract.limits import ContractError
from iort_contract.messages.requests.ask import INVALID
from iort_contract.track import Track, parse_track, track_of


def work(robot: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """The line from a ``track`` and a ``car``. Raises `RefusedError` for what is neither."""
    try:
        track, car = _track(body.get("track")), _car(robot, body.get("car", {}))
        values = {name: found["value"] for name, found in car.items()}
        centre = reference(track, values.pop("width_m"))
        offset, limits = least_curvature(centre), Limits(**values)
        points = centre.line(offset)
        found, before = profile(points, limits), profile(centre.points, limits)
    except (AnalysisError, ContractError) as error:
        raise RefusedError(INVALID, str(error)) from error
    columns = {
        "s_m": found.at_m,
        "x_m": points[:, 0],
        "y_m": points[:, 1],
        "offset_m": offset,
        "curvature_1pm": found.curvature_1pm,
        "speed_mps": found.speed_mps,
        "time_s": found.time_s,
    }
    return {
        "length_m": round(found.length_m, 3),
        "lap_s": round(found.lap_s, 3),
        "centre_line_lap_s": round(before.lap_s, 3),
        "car": car,
        "line": {name: [round(float(value), 4) for value in values] for name, values in columns.items()},
    }


def _track(given: Any) -> Track:
    if isinstance(given, str):
        return parse_track(given)
    if isinstance(given, dict):
        return track_of(given)
    raise ContractError(f"track must be a CSV text or an object of columns, got {shown(given)}")


def _car(robot: str, given: Any) -> dict[str, dict[str, Any]]:
    """Each limit with its value and where it is from: the question, the calibration, or the default."""
    if not isinstance(given, dict) or given.keys() - CAR_LIMITS.keys():
        raise ContractError(f"car must be an object of {', '.join(CAR_LIMITS)}, got {shown(given)}")
    # Without a calibration to look up, the table is not read.
    wanted = any(limit.calibrated and name not in given for name, limit in CAR_LIMITS.items())
    drives = parameters.newest_drives(robot) if wanted else []
    known = {name: one.value for name, (one, _) in parameters.latest(drives).items()}
    car = {}
    for name, limit in CAR_LIMITS.items():
        source, value = "question", given.get(name)
        if name not in given:
            calibrated = _calibrated(limit, known)
            source, value = ("default", limit.default) if calibrated is None else ("calibration", calibrated)
        car[name] = {"value": _checked(limit, value), "unit": limit.unit, "from": source}
    return car


def _calibrated(limit: CarLimit, known: Mapping[str, float]) -> float | None:
    """The limit by the robot's parameters; None if one is missing, or the result is no such limit."""
    values = [known.get(name) for name in limit.calibrated]
    if not values or None in values:
        return None
    value = values[0]
    if limit.name == "power_w":
        volts, ohms = (float(one or 0) for one in values)
        value = SAG * (1 - SAG) * volts**2 / ohms if ohms > 0 else None
    return value if value is not None and limit.low <= value <= limit.high else None


def _checked(limit: CarLimit, value: Any) -> float:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    # Compared before it becomes a float, which holds no integer of 400 digits.
    if not is_number or not limit.low <= value <= limit.high:
        raise ContractError(
            f"{limit.name} must be {limit.low:g} to {limit.high:g} {limit.unit}, got {shown(value)}"
        )
    return float(value)
