"""Answers to the live page about findings and analysed drives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from iort_contract.catalog.findings import GROUPS, KINDS
from iort_contract.messages.analysis import AnalysedDrive
from iort_contract.messages.findings import Estimate, Finding
from iort_contract.messages.insights import (
    DriveEntry,
    EstimateEntry,
    FindingEntry,
    InsightsAnswer,
)
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.data import findings as stored
from iort_station.fleet import registry

FAILED = "analysis_failed"
# What is shown of a robot, and of each one of the fleet.
_DRIVES, _FINDINGS = 60, 60
_FLEET_DRIVES, _FLEET_FINDINGS = 3, 10
_READERS = 8


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
        if finding.kind == FAILED
    ]
