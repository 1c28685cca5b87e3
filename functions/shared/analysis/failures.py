"""Plans that failed: ranges of a robot whose drives could not be found."""

from __future__ import annotations

from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import NO_RUN, Finding

# A night plans what failed in the nights before it, up to a week.
_PLANNED_AGAIN_US = 7 * 86_400 * 1_000_000


def failed_plans(
    table: FindingsTable, robot: str, start_us: int, end_us: int, *, again: bool
) -> list[Finding]:
    """The findings about a robot's failed plans which a run of a range makes good.

    A run that looks for new drives begins at the first of them. One that analyses drives ``again`` keeps to
    the range that was asked for.
    """
    from_us = start_us if again else max(0, start_us - _PLANNED_AGAIN_US)
    found = table.findings(robot, from_us, end_us)
    return [one for one in found if one.drive.run == NO_RUN and one.to_us <= end_us]
