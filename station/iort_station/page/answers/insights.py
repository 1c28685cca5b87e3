"""Answers to the live page about findings and analysed drives."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from iort_contract.catalog.analysis.kinds import ANALYSIS_FAILED, KINDS
from iort_contract.catalog.analysis.parameters import GROUPS
from iort_contract.messages.analysis.findings import Estimate, Finding
from iort_contract.messages.analysis.insights import (
    AnalysisAnswer,
    AnalysisStarted,
    DriveEntry,
    EstimateEntry,
    FindingEntry,
    InsightsAnswer,
)
from iort_contract.messages.analysis.run import AnalysedDrive, AnalysisRequest
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.data.analysis import findings as stored
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.page.answers.parameters import text, whole

# What is shown of a robot, and of each one of the fleet.
_DRIVES, _FINDINGS = 60, 60
_FLEET_DRIVES, _FLEET_FINDINGS = 3, 10
_READERS = 8
# The page asks for days; a year is more than it offers.
_LONGEST_S = 366 * 86_400


def insights(cloud: Cloud, asked: Mapping[str, str]) -> InsightsAnswer:
    """The newest findings and drives of ``robot``; without one, of all robots."""
    robots = [check_robot(asked["robot"])] if asked.get("robot") else sorted(registry.presence(cloud))
    drives, findings = (_DRIVES, _FINDINGS) if asked.get("robot") else (_FLEET_DRIVES, _FLEET_FINDINGS)
    table = stored.table(cloud)

    def of(robot: str) -> tuple[list[Finding], list[AnalysedDrive]]:
        return list(islice(table.findings(robot), findings)), list(table.drives(robot, most=drives))

    with ThreadPoolExecutor(_READERS) as pool:
        found = list(pool.map(of, robots))
    told = [finding for some, _ in found for finding in some]
    return {
        "findings": [_finding(finding) for finding in _newest(told)],
        "drives": sorted(
            [*_failed(told), *(_drive(drive) for _, some in found for drive in some)],
            key=lambda drive: -drive["from_us"],
        ),
        "groups": {
            group: {p.name: {"unit": p.unit, "meaning": p.meaning, "worse": p.worse} for p in parameters}
            for group, parameters in GROUPS.items()
        },
    }


def analyse(cloud: Cloud, asked: Mapping[str, str]) -> AnalysisStarted:
    """Start an analysis of the drives of the last ``last_s``: of ``robot``, or of all robots without one."""
    last_us = whole(asked, "last_s", 1, _LONGEST_S) * 1_000_000
    robots = (check_robot(asked["robot"]),) if asked.get("robot") else ()
    now_us = time.time_ns() // 1000
    run = analysis.start(cloud, AnalysisRequest(robots, now_us - last_us, now_us, again=True))
    return {"run": run.rpartition(":")[2]}


def progress(cloud: Cloud, asked: Mapping[str, str]) -> AnalysisAnswer:
    """How far the ``run`` of an analysis is; raises `StationError` if it has failed."""
    found = analysis.look(cloud, analysis.named(cloud, text(asked, "run")))
    return {"running": found.state == analysis.RUNNING, "drives": found.drives, "done": found.done}


def estimate(of: Estimate) -> EstimateEntry:
    """An estimate as the page has it."""
    return {"value": of.value, "low": of.low, "high": of.high, "unit": of.unit}


def _newest(findings: Iterable[Finding]) -> list[Finding]:
    return sorted(findings, key=lambda finding: -finding.from_us)


def _finding(finding: Finding) -> FindingEntry:
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


def _drive(drive: AnalysedDrive) -> DriveEntry:
    return {
        "robot": drive.drive.robot,
        "from_us": drive.drive.start_us,
        "to_us": drive.end_us + 1,
        "samples": drive.samples,
        "failed": "",
        "repairs": dict(drive.repairs),
        "estimates": {name: estimate(one) for name, one in drive.estimates.items()},
        "missing": dict(drive.missing),
    }


def _failed(findings: Iterable[Finding]) -> list[DriveEntry]:
    """The drives that could not be analysed, which are findings."""
    return [
        {
            "robot": finding.drive.robot,
            "from_us": finding.drive.start_us,
            "to_us": max(finding.to_us, finding.drive.start_us + 1),
            "samples": 0,
            "failed": finding.text,
            "repairs": {},
            "estimates": {},
            "missing": {},
        }
        for finding in findings
        if finding.kind == ANALYSIS_FAILED
    ]
