"""Evaluate: compares a robot's drives of a run with its earlier ones, and with other robots'.

The findings go to the bucket, for `present`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import Any

from functions.shared import clients
from functions.shared.analysis import Kept, failed_plans, failure, waits
from functions.shared.clients import variables
from iort_analysis.drives.stretches import LONGEST_US
from iort_analysis.evaluation import evaluate
from iort_analysis.results import DriveResult, Measured, decode_result
from iort_contract.catalog.analysis import ANALYSIS_FAILED
from iort_contract.catalog.environments import EvaluateEnvironment
from iort_contract.cloud import drive_prefix, findings_key, plan_key, waiting_key
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import (
    AnalysedDrive,
    DriveKey,
    Finding,
    PlannedDrive,
    decode_planned,
    encode_finding,
    encode_planned,
)

# The newest drives of a robot before those of the run, and of each other robot up to its end, with which a
# drive is compared.
_OWN, _OTHERS = 300, 20
_NO_ANSWER = {"Cause": "they ended without an answer"}


class Drives:
    """The analysed drives of a robot and of ``others``, up to the end of the run's range."""

    def __init__(self, table: FindingsTable, kept: Kept, others: Sequence[str], end_us: int) -> None:
        self._table, self._kept, self._others, self._end_us = table, kept, others, end_us
        self._plan = cache(self._read_plan)

    def of_run(self, job: str, robot: str, began_us: int) -> list[DriveResult]:
        """The results of a robot's drives in a run of the analysis that began then."""
        plan = self._plan(job, robot)
        if not plan:
            return []
        first_us = min(one.drive.start_us for one in plan)
        last_us = max(one.drive.start_us for one in plan)
        rows = self._table.drives(robot, first_us, last_us + 1)
        # A drive that failed has no row of this run, and perhaps an older result.
        # Another run at the same time may have replaced the row of this one.
        planned = {one.drive for one in plan}
        made = [
            one.drive
            for one in rows
            if one.job == job or (one.drive in planned and one.analysed_us >= began_us)
        ]
        found = [self._kept.json(f"{drive_prefix(drive)}result.json") for drive in made]
        return [decode_result(content) for content in found if content is not None]

    def made_good(self, job: str, robot: str, start_us: int, *, again: bool) -> list[DriveKey]:
        """What stands for the robot's failed plans whose range this run has planned."""
        if self._plan(job, robot) is None:
            return []
        return [one.drive for one in failed_plans(self._table, robot, start_us, self._end_us, again=again)]

    def replaced(self, job: str, robot: str, results: Sequence[DriveResult]) -> list[DriveKey]:
        """Drives of earlier runs of the analysis that are parts of ``results``: batches that came late move a
        drive's start, or join two drives."""
        planned = {one.drive for one in self._plan(job, robot) or ()}
        first_us = max(0, min(one.drive.start_us for one in results) - 2 * LONGEST_US)
        last_us = max(one.end_us for one in results)
        before = {one.drive: one.end_us for one in self._table.drives(robot, first_us, last_us + 1)}
        failed = self._table.findings(robot, first_us, last_us + 1)
        before |= {one.drive: one.to_us for one in failed if one.kind == ANALYSIS_FAILED}
        return [
            drive
            for drive, end_us in before.items()
            if drive not in planned
            and any(
                drive.run == one.drive.run and drive.start_us <= one.end_us and one.drive.start_us <= end_us
                for one in results
            )
        ]

    def lost(
        self, job: str, robot: str, made: Collection[DriveKey]
    ) -> Iterator[tuple[DriveKey, list[Finding]]]:
        """The planned drives that are neither among those ``made`` nor have failed with a finding, which then
        could not be written; with the findings that they get."""
        for one in self._plan(job, robot) or ():
            if one.drive not in made:
                found = self._table.of_drive(one.drive)
                if ANALYSIS_FAILED not in {finding.kind for finding in found}:
                    yield one.drive, [*found, failure(encode_planned(one), _NO_ANSWER)]

    def history(
        self, robot: str, results: Sequence[DriveResult], replaced: Collection[DriveKey]
    ) -> list[Measured]:
        """The drives of a robot among ``results``, and the newest ones before, without those ``replaced``."""
        first_us = min(one.drive.start_us for one in results)
        among = self._table.drives(robot, first_us, self._end_us)
        before = self._table.drives(robot, end_us=first_us, most=_OWN)
        return [_measured(one) for one in chain(among, before) if one.drive not in replaced]

    def fleet(self) -> list[Measured]:
        """The newest drives of the other robots."""
        return [
            _measured(one)
            for other in self._others
            for one in self._table.drives(other, end_us=self._end_us, most=_OTHERS)
        ]

    def _read_plan(self, job: str, robot: str) -> list[PlannedDrive] | None:
        """The drives of a robot in a run; None if they could not be found."""
        for drives in (True, False):
            content = self._kept.json(plan_key(job, robot, drives=drives))
            if content is not None:
                return [decode_planned(one) for one in content]
        return None


def evaluated(
    drives: Drives, job: str, robot: str, began_us: int
) -> tuple[dict[DriveKey, list[Finding]], list[DriveKey]]:
    """The findings about each of a robot's drives in a run, and the earlier drives that these replace."""
    results = drives.of_run(job, robot, began_us)
    if not results:
        return {}, []
    replaced = drives.replaced(job, robot, results)
    found = evaluate(results, drives.history(robot, results, replaced), drives.fleet())
    of_drives = {result.drive: [one for one in found if one.drive == result.drive] for result in results}
    return of_drives, replaced


def _measured(analysed: AnalysedDrive) -> Measured:
    return Measured(analysed.drive, analysed.estimates)


def handler(event: Mapping[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the state Evaluate."""
    given = variables(EvaluateEnvironment)
    job, robot = event["job"], event["robot"]
    kept = Kept(clients.s3(), given.files_bucket)
    table = FindingsTable(clients.dynamodb(), given.findings_table)
    drives = Drives(table, kept, event["others"], event["end_us"])
    found, replaced = evaluated(drives, job, robot, event["began_us"])
    of_drives = [*found.items(), *drives.lost(job, robot, found.keys())]
    waiting = kept.json(waiting_key(job, robot))
    if waiting is not None:
        finding = waits(robot, waiting)
        of_drives.append((finding.drive, [finding]))
    gone = [*replaced, *drives.made_good(job, robot, event["start_us"], again=event["again"])]
    content = {
        "drives": [
            {"drive": vars(drive), "findings": [encode_finding(one) for one in some]}
            for drive, some in of_drives
        ],
        "gone": list(map(vars, gone)),
    }
    kept.put_json(findings_key(job, robot), content)
    return {"drives": len(of_drives), "findings": sum(len(some) for _, some in of_drives)}
