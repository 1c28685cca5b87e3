"""The parameters of a robot, from the analysis of its drives."""

from __future__ import annotations

from functions.shared import clients
from functions.shared.environment import variables
from iort_contract.catalog.environments import AnswerEnvironment
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import DriveKey, Estimate

# A parameter that none of so many drives has is not known.
_DRIVES = 50


def latest(robot: str) -> dict[str, tuple[Estimate, DriveKey]]:
    """Each parameter with the newest drive that has it."""
    table = FindingsTable(clients.dynamodb(), variables(AnswerEnvironment).findings_table)
    found: dict[str, tuple[Estimate, DriveKey]] = {}
    for analysed in table.drives(robot, most=_DRIVES):
        for name, estimate in analysed.estimates.items():
            found.setdefault(name, (estimate, analysed.drive))
    return found
