"""What is known of drives, for the live page: findings, analysed drives, laps, and people's notes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import islice

import numpy as np

from iort_analysis import AnalysisError
from iort_analysis.mining.laps import compare
from iort_analysis.raceline import Limits, least_curvature, profile, reference
from iort_analysis.results import Mined
from iort_analysis.samples.blocks import Column
from iort_contract.catalog.analysis import ANALYSIS_FAILED, GROUPS, KINDS, LAPS_TABLE, PLACES_TABLE
from iort_contract.catalog.questions import CAR_LIMITS
from iort_contract.messages import insights as messages
from iort_contract.messages.analysis import AnalysedDrive, AnalysisRequest, Estimate, Finding
from iort_contract.messages.page import RacelineAnswer
from iort_contract.messages.recorder import MAX_SPAN_S
from iort_contract.topics import check_robot
from iort_contract.track import Track
from iort_station.cloud import Cloud
from iort_station.data import findings as stored
from iort_station.data.runs import laps_within
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.operations.alarms import user
from iort_station.page.requests import robot_of, text, whole

# What is shown of a robot, and of each one of the fleet.
_DRIVES, _FINDINGS = 60, 60
_FLEET_DRIVES, _FLEET_FINDINGS = 3, 10
_READERS = 8
# The page asks for days; a year is more than it offers.
_LONGEST_S = 366 * 86_400


def insights(cloud: Cloud, request: Mapping[str, str]) -> messages.InsightsAnswer:
    """The newest findings and drives of ``robot``; without one, of all robots."""
    robots = [check_robot(request["robot"])] if request.get("robot") else sorted(registry.presence(cloud))
    drives, findings = (_DRIVES, _FINDINGS) if request.get("robot") else (_FLEET_DRIVES, _FLEET_FINDINGS)
    table = stored.findings_table(cloud)

    def of(robot: str) -> tuple[list[Finding], list[AnalysedDrive]]:
        return list(islice(table.findings(robot), findings)), list(table.drives(robot, most=drives))

    with ThreadPoolExecutor(_READERS) as pool:
        entries = list(pool.map(of, robots))
    newest = sorted(
        (finding for some, _ in entries for finding in some), key=lambda finding: -finding.from_us
    )
    return {
        "findings": [_finding(finding) for finding in newest],
        "drives": sorted(
            [*_failed(newest), *(_drive(drive) for _, some in entries for drive in some)],
            key=lambda drive: -drive["from_us"],
        ),
        "groups": {
            group: {p.name: {"unit": p.unit, "meaning": p.meaning, "worse": p.worse} for p in parameters}
            for group, parameters in GROUPS.items()
        },
    }


def analyse(cloud: Cloud, request: Mapping[str, str]) -> messages.AnalysisStarted:
    """Start an analysis of the drives of the last ``last_s``: of ``robot``, or of all robots without one."""
    last_us = whole(request, "last_s", 1, _LONGEST_S) * 1_000_000
    robots = (check_robot(request["robot"]),) if request.get("robot") else ()
    now_us = time.time_ns() // 1000
    run = analysis.start(cloud, AnalysisRequest(robots, now_us - last_us, now_us, again=True))
    return {"run": run.rpartition(":")[2]}


def progress(cloud: Cloud, request: Mapping[str, str]) -> messages.AnalysisAnswer:
    """How far the ``run`` of an analysis is; raises `StationError` if it has failed."""
    run = analysis.look(cloud, analysis.named(cloud, text(request, "run")))
    return {"running": run.state == analysis.RUNNING, "drives": run.drives, "done": run.done}


def estimate(of: Estimate) -> messages.EstimateEntry:
    """An estimate as the page has it."""
    return {"value": of.value, "low": of.low, "high": of.high, "unit": of.unit}


def _finding(finding: Finding) -> messages.FindingEntry:
    kind = KINDS.get(finding.kind)
    return {
        "id": finding.id,
        "robot": finding.drive.robot,
        "start_us": finding.drive.start_us,
        "from_us": finding.from_us,
        "to_us": finding.to_us,
        "kind": finding.kind,
        "severity": "info" if kind is None else kind.severity,
        # A later version may have had other kinds.
        "meaning": finding.kind.replace("_", " ") if kind is None else kind.meaning,
        "action": "" if kind is None else kind.action,
        "subject": finding.subject,
        "stream": finding.stream,
        "fields": list(finding.fields),
        "text": finding.text,
        "effect": None if finding.effect is None else estimate(finding.effect),
        "baseline": None if finding.baseline is None else estimate(finding.baseline),
        "q": finding.q,
    }


def _drive(drive: AnalysedDrive) -> messages.DriveEntry:
    return {
        "robot": drive.drive.robot,
        "from_us": drive.drive.start_us,
        "to_us": drive.end_us + 1,
        "samples": drive.samples,
        "failed": "",
        "repairs": dict(drive.repairs),
        "estimates": {name: estimate(entry) for name, entry in drive.estimates.items()},
        "missing": dict(drive.missing),
    }


def _failed(findings: Iterable[Finding]) -> Iterator[messages.DriveEntry]:
    """The drives that could not be analysed, which are findings."""
    for finding in findings:
        if finding.kind == ANALYSIS_FAILED:
            end_us = max(finding.to_us - 1, finding.drive.start_us)
            drive = _drive(AnalysedDrive(finding.drive, end_us, "", 0, {}, {}, {}))
            yield {**drive, "failed": finding.text}


# An hour of a VESC at 100 Hz and of its pose.
_MOST_VALUES = 10_000_000
# A viewer compares several laps of a drive, whose samples are read once.
_KEPT_LAPS = 8


@lru_cache(_KEPT_LAPS)
def _mined(cloud: Cloud, robot: str, start_us: int, end_us: int) -> Mined:
    return laps_within(cloud, robot, start_us, end_us, most=_MOST_VALUES)


def _mined_of(cloud: Cloud, request: Mapping[str, str]) -> Mined:
    start_us, end_us = (whole(request, name, 0, 2**53) for name in ("from_us", "to_us"))
    return _mined(cloud, robot_of(request), start_us, end_us)


def laps(cloud: Cloud, request: Mapping[str, str]) -> messages.LapsAnswer:
    """The laps of ``robot`` from ``from_us`` to ``to_us``."""
    mined = _mined_of(cloud, request)
    table = mined.tables.get(LAPS_TABLE)
    estimates = {name: estimate(entry) for name, entry in mined.estimates.items()}
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


def delta(cloud: Cloud, request: Mapping[str, str]) -> messages.DeltaAnswer:
    """How far the lap ``other`` is behind the lap ``one``, at each place of the track."""
    mined = _mined_of(cloud, request)
    one, other = (whole(request, name, 1, 10**6) for name in ("one", "other"))
    if PLACES_TABLE not in mined.tables:
        raise StationError(next(iter(mined.missing.values()), "no laps"))
    try:
        compared = compare(mined.tables[PLACES_TABLE], one, other)
    except AnalysisError as error:
        raise StationError(str(error)) from error
    places = compared["place_m"]
    in_metres = bool(np.isfinite(places).all())
    return {
        "places": (places if in_metres else np.linspace(0, 100, len(places))).tolist(),
        "unit": "m" if in_metres else "%",
        "delta_s": compared["delta_s"].tolist(),
        "one_mps": _known(compared["one_mps"]),
        "other_mps": _known(compared["other_mps"]),
    }


@lru_cache(1)
def raceline(track: Track | None) -> RacelineAnswer:
    """The line of least curvature around the page's track, for a car of the usual limits."""
    if track is None:
        return {"x_m": [], "y_m": [], "lap_s": 0.0, "reason": "the page has no track"}
    car = {name: limit.default for name, limit in CAR_LIMITS.items()}
    try:
        centre = reference(track, car.pop("width_m"))
        points = centre.line(least_curvature(centre))
        lap_s = profile(points, Limits(**car)).lap_s
    except AnalysisError as error:
        return {"x_m": [], "y_m": [], "lap_s": 0.0, "reason": str(error)}
    x_m, y_m = np.round(points.T, 4).tolist()
    return {"x_m": x_m, "y_m": y_m, "lap_s": lap_s, "reason": ""}


def _known(column: Column) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in column]


_NOTES = 200


def notes(cloud: Cloud, request: Mapping[str, str]) -> messages.NotesAnswer:
    """The newest notes about ``robot``, or about the fleet; those from ``from_us`` to ``to_us``, if given."""
    robot = check_robot(request["robot"]) if request.get("robot") else None
    start_us, end_us = (
        whole(request, name, 0, 2**53) if name in request else None for name in ("from_us", "to_us")
    )
    newest = stored.notes(cloud, robot, start_us, end_us, most=_NOTES)
    return {
        "notes": [
            {"id": note.id, "robot": note.robot, "t_us": note.t_us, "text": note.text, "by": note.by}
            for note in newest
        ]
    }


def write_note(cloud: Cloud, request: Mapping[str, str]) -> messages.NotesAnswer:
    """Write a note with ``text`` about ``robot`` at ``t_us``, or about now; its recorder keeps the ``keep_s``
    before that time, if they are given."""
    robot = text(request, "robot")
    t_us = whole(request, "t_us", 0, 2**53) if "t_us" in request else None
    keep_us = whole(request, "keep_s", 1, round(MAX_SPAN_S)) * 1_000_000 if "keep_s" in request else 0
    stored.write_note(cloud, robot, text(request, "text"), by=user(), t_us=t_us, keep_us=keep_us)
    return notes(cloud, {"robot": robot})


def remove_note(cloud: Cloud, request: Mapping[str, str]) -> messages.NotesAnswer:
    """Delete the note ``id`` of ``robot``."""
    robot = text(request, "robot")
    stored.remove_note(cloud, robot, text(request, "id"))
    return notes(cloud, {"robot": robot})
