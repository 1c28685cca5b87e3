"""What the analysis says of robots: findings, and the drives that it has analysed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import Finding
from iort_contract.messages.analysis.run import AnalysedDrive
from iort_station.cloud import Cloud
from iort_station.fleet import registry


def findings(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[Finding]:
    """Findings about drives that begin in a range, the newest first; of all robots without one."""
    found = [
        one
        for name in _named(cloud, robot)
        for one in islice(table(cloud).findings(name, start_us, end_us), most)
    ]
    return sorted(found, key=lambda one: one.id, reverse=True)[:most]


def drives(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[AnalysedDrive]:
    """Analysed drives that begin in a range, the newest first; of all robots without one."""
    found = [
        one for name in _named(cloud, robot) for one in table(cloud).drives(name, start_us, end_us, most=most)
    ]
    return sorted(found, key=lambda one: str(one.drive), reverse=True)[:most]


def table(cloud: Cloud) -> FindingsTable:
    """The table of findings."""
    return FindingsTable(cloud.client("dynamodb"), cloud.output("storage", "FindingsTable"))


def _named(cloud: Cloud, robot: str | None) -> Iterator[str]:
    if robot is not None:
        yield robot
        return
    yield from sorted(row["robot"] for row in registry.listed(cloud))
