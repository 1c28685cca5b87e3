"""Evaluate: compares the drives of a run with each robot's earlier ones, and with the fleet's.

The findings go to the bucket, for `present`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import Any

from functions.shared import clients
from functions.shared.analysis.kept import Kept
from functions.shared.analysis.recordings import robots_of
from functions.shared.environment import variables
from iort_analysis.evaluation.evaluate import evaluate
from iort_analysis.results import DriveResult, Measured, decode_result
from iort_contract.catalog.environments import EvaluateEnvironment
from iort_contract.cloud import drive_prefix, findings_key, plan_key
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import NO_RUN, DriveKey, Finding, encode_finding
from iort_contract.messages.analysis.run import AnalysedDrive, decode_planned

# The newest drives of a robot before those of the run, and of each other robot up to its end, with which a
# drive is compared.
_OWN, _OTHERS = 300, 20


class Drives:
    """The analysed drives of all robots, up to the end of the run's range."""

    def __init__(self, table: FindingsTable, kept: Kept, robots: Sequence[str], end_us: int) -> None:
        self._table, self._kept, self._robots, self._end_us = table, kept, robots, end_us
        self._newest = cache(self._read)

    def of_run(self, job: str, robot: str) -> list[DriveResult]:
        """The results that a run of the analysis has made of a robot's drives."""
        plan = [decode_planned(one) for one in self._kept.json(plan_key(job, robot)) or ()]
        if not plan:
            return []
        first_us = min(one.drive.start_us for one in plan)
        last_us = max(one.drive.start_us for one in plan)
        rows = self._table.drives(robot, first_us, last_us + 1)
        # A drive that failed has no row of this run, and perhaps an older result.
        made = [one.drive for one in rows if one.job == job]
        found = [self._kept.json(f"{drive_prefix(drive)}result.json") for drive in made]
        return [decode_result(content) for content in found if content is not None]

    def made_good(self, job: str, robot: str, start_us: int) -> list[DriveKey]:
        """What stands for the robot's failed plans whose range this run has planned."""
        if self._kept.json(plan_key(job, robot)) is None:
            return []
        found = self._table.findings(robot, start_us, self._end_us)
        return [one.drive for one in found if one.drive.run == NO_RUN and one.to_us <= self._end_us]

    def history(self, robot: str, results: Sequence[DriveResult]) -> list[Measured]:
        """The drives of a robot among ``results``, and the newest ones before."""
        first_us = min(one.drive.start_us for one in results)
        among = self._table.drives(robot, first_us, self._end_us)
        before = self._table.drives(robot, end_us=first_us, most=_OWN)
        return [_measured(one) for one in chain(among, before)]

    def fleet(self, robot: str) -> list[Measured]:
        """The newest drives of the other robots."""
        return [one for other in self._robots if other != robot for one in self._newest(other)]

    def _read(self, robot: str) -> tuple[Measured, ...]:
        return tuple(_measured(one) for one in self._table.drives(robot, end_us=self._end_us, most=_OTHERS))


def findings(drives: Drives, job: str, robots: Sequence[str]) -> Iterator[tuple[DriveResult, list[Finding]]]:
    """Each drive of a run, with the findings about it."""
    for robot in robots:
        results = drives.of_run(job, robot)
        found = evaluate(results, drives.history(robot, results), drives.fleet(robot)) if results else []
        for result in results:
            yield result, [one for one in found if one.drive == result.drive]


def _measured(analysed: AnalysedDrive) -> Measured:
    return Measured(analysed.drive, analysed.estimates)


def handler(event: Mapping[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the state Evaluate."""
    given = variables(EvaluateEnvironment)
    dynamodb, kept = clients.dynamodb(), Kept(clients.s3(), given.files_bucket)
    drives = Drives(
        FindingsTable(dynamodb, given.findings_table),
        kept,
        robots_of(dynamodb, given.robots_table),
        event["end_us"],
    )
    made = [
        {"drive": vars(result.drive), "findings": [encode_finding(one) for one in found]}
        for result, found in findings(drives, event["job"], event["robots"])
    ]
    good = [
        {"drive": vars(drive), "findings": []}
        for robot in event["robots"]
        for drive in drives.made_good(event["job"], robot, event["start_us"])
    ]
    kept.put_json(findings_key(event["job"]), made + good)
    return {"drives": len(made), "findings": sum(len(one["findings"]) for one in made)}
