"""The parameters of a robot, from the analysis of its drives."""

from __future__ import annotations

from collections.abc import Iterable

from functions.shared import clients
from functions.shared.environment import variables
from iort_contract.catalog.environments import AnswerEnvironment
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import DriveKey, Estimate
from iort_contract.messages.analysis.run import AnalysedDrive

# A parameter that none of so many drives has is not known.
_DRIVES = 50


def newest_drives(robot: str) -> list[AnalysedDrive]:
    """The robot's analysed drives, the newest first."""
    table = FindingsTable(clients.dynamodb(), variables(AnswerEnvironment).findings_table)
    return list(table.drives(robot, most=_DRIVES))


def latest(drives: Iterable[AnalysedDrive]) -> dict[str, tuple[Estimate, DriveKey]]:
    """Each parameter with the first drive that has it."""
    found: dict[str, tuple[Estimate, DriveKey]] = {}
    for analysed in drives:
        for name, estimate in analysed.estimates.items():
            found.setdefault(name, (estimate, analysed.drive))
    return found
