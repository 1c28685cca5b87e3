"""The state machine of the analysis, and the schedules that call it and the archive."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta, timezone
from typing import Any

from iort_contract.archive import DUE, TASK
from iort_contract.catalog.analysis import ANALYSIS_FAILED
from iort_contract.messages.analysis import AnalysisRequest
from iort_station.data import findings
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.operations import analysis
from iort_station.operations.analysis import SUCCEEDED, Progress
from testkit.target import EMBEDDED, configure
from testkit.waiting import until
from verify.lab import Lab
from verify.question import Seen, question

_SAMPLES, _DAY_US = 30, 86_400_000_000


def _driven(lab: Lab, base: str) -> str:
    """The name of a new robot that has just driven for half a minute."""
    return lab.driven(base, int(time.time() - 2 * _SAMPLES) * 1_000_000, _SAMPLES).robot


def _start(lab: Lab, *robots: str, days_ago: int = 0) -> str:
    """Start a run over a day of these robots, or of all."""
    end_us = time.time_ns() // 1000 - days_ago * _DAY_US
    return analysis.start(lab.cloud, AnalysisRequest(robots, end_us - _DAY_US, end_us))


def _end(lab: Lab, run: str) -> Progress:
    """The end of a run; raises `StationError` if it fails."""
    *_, last = analysis.watch(lab.cloud, run)
    return last


def _samples(lab: Lab, robot: str) -> list[int]:
    """The samples of each analysed drive of the robot."""
    return [drive.samples for drive in findings.drives(lab.cloud, robot)]


def _failed(lab: Lab, robot: str) -> int:
    """The number of the robot's findings that its drive could not be analysed."""
    return sum(finding.kind == ANALYSIS_FAILED for finding in findings.findings(lab.cloud, robot))


@contextmanager
def _broken(lab: Lab, name: str) -> Iterator[None]:
    """Take a function's variables away, without which it raises; give them back at the end."""
    client, environment = lab.client("lambda"), lab.configuration(name)["Environment"]
    configure(client, name, Environment={"Variables": {}})
    try:
        yield
    finally:
        configure(client, name, Environment={"Variables": environment["Variables"]})


@question(
    "analysis.no_robot",
    aws="states:state-map-inline",
    expected={"state": SUCCEEDED, "drives": 0, "findings": 0},
)
def no_robot(lab: Lab) -> Seen:
    """A run of all robots ends well where there is none. It is the first question, so that a new deployment
    has none; in an older one the run is of a day on which nobody drove."""
    last, robots = _end(lab, _start(lab, days_ago=3650)), len(list(registry.listed(lab.cloud)))
    return {
        "state": last.state,
        "drives": last.drives or 0,
        "findings": last.findings,
        "note_robots": robots,
    }


@question(
    "analysis.empty_plan",
    aws="states:input-output-itemreader",
    expected={"state": SUCCEEDED, "drives": 0, "findings": 0},
)
def empty_plan(lab: Lab) -> Seen:
    """A run of a robot that has never driven ends well. AWS does not document what its reader of objects
    (LOAD_AND_FLATTEN) does if they hold no item."""
    last = _end(lab, _start(lab, lab.registered().robot))
    return {"state": last.state, "drives": last.drives or 0, "findings": last.findings}


@question(
    "analysis.one_drive",
    aws="states:state-map-distributed states:iam-policies-eg-dist-map",
    expected={"state": SUCCEEDED, "drives": 1, "done": 1, "samples": [_SAMPLES], "failed": 0},
)
def one_drive(lab: Lab) -> Seen:
    """The distributed map reads the plan's drive from the bucket and starts a child execution for it, with
    the rights that AWS lists for such a map. The drive's result is in the table at the end."""
    robot = _driven(lab, "verify-drive")
    last = _end(lab, _start(lab, robot))
    return {
        "state": last.state,
        "drives": last.drives,
        "done": last.done,
        "samples": _samples(lab, robot),
        "failed": _failed(lab, robot),
    }


@question(
    "analysis.failing_drive",
    aws="states:concepts-error-handling",
    expected={"state": SUCCEEDED, "failed": 1, "next": SUCCEEDED, "failed_then": 0, "samples": [_SAMPLES]},
)
def failing_drive(lab: Lab) -> Seen:
    """A drive whose function raises at each attempt becomes a finding, and the run ends well. The next run
    analyses the drive and removes the finding."""
    robot = _driven(lab, "verify-fails")
    with _broken(lab, lab.cloud.output("analysis", "AnalyseFunction")):
        state, failed = _end(lab, _start(lab, robot)).state, _failed(lab, robot)
    # The next run plans the drive again, because it has no result.
    following = _end(lab, _start(lab, robot)).state
    then, samples = _failed(lab, robot), _samples(lab, robot)
    return {"state": state, "failed": failed, "next": following, "failed_then": then, "samples": samples}


@question(
    "analysis.stopped",
    aws="states-api:API_StopExecution states:redrive-map-run",
    expected={"stopped": "ABORTED", "watched": True, "next": SUCCEEDED, "samples": [_SAMPLES]},
)
def stopped(lab: Lab) -> Seen:
    """A run that is stopped midway is ABORTED, which `iort analyse` reports. Children of its map may go on,
    and do no harm: the next run analyses the drive, once."""
    robot, client = _driven(lab, "verify-stopped"), lab.client("stepfunctions")
    run = _start(lab, robot)
    until(
        lambda: client.get_execution_history(executionArn=run, maxResults=10)["events"][2:],
        "the first work of a run",
        poll_s=0.05,
    )
    client.stop_execution(executionArn=run)
    try:
        watched = _end(lab, run).state
    except StationError as error:
        watched = str(error)
    then = _end(lab, _start(lab, robot))
    return {
        "stopped": client.describe_execution(executionArn=run)["status"],
        "watched": "the analysis has ended: aborted" in watched,
        "next": then.state,
        "samples": _samples(lab, robot),
        "note_drives_of_the_next": then.drives,
    }


# AWS calls within 60 s of the time.
_AHEAD_S, _EMBEDDED_AHEAD_S, _WITHIN_S = 60, 1, 240.0


def _schedule_soon(lab: Lab, schedule: str) -> Mapping[str, Any]:
    """Make a copy of a deployed schedule that calls the same target once, soon; returns the target."""
    client, prefix = lab.client("scheduler"), f"{lab.namespace}-{schedule}"
    (entry,) = client.list_schedules(NamePrefix=prefix)["Schedules"]
    model, copy = client.get_schedule(Name=entry["Name"]), lab.name("verify-schedule")
    ahead_s = _EMBEDDED_AHEAD_S if lab.target.kind == EMBEDDED else _AHEAD_S
    at = datetime.now(timezone.utc) + timedelta(seconds=ahead_s)

    def delete() -> None:
        with suppress(client.exceptions.ResourceNotFoundException):
            client.delete_schedule(Name=copy)

    client.create_schedule(
        Name=copy,
        ScheduleExpression=f"at({at:%Y-%m-%dT%H:%M:%S})",
        FlexibleTimeWindow=model["FlexibleTimeWindow"],
        Target=model["Target"],
        ActionAfterCompletion="DELETE",
    )
    lab.undo(delete)
    return dict(model["Target"])


@question(
    "schedules.archive",
    aws="scheduler:schedule-types scheduler:setting-up",
    expected={"called": True},
)
def archive_scheduled(lab: Lab) -> Seen:
    """A one-time copy of the archive's hourly schedule calls the function, by the schedule's role and with
    its input, within a minute of its time."""
    function, began_ms = lab.cloud.output("archive", "ArchiveFunction"), int(time.time() * 1000)
    task = json.dumps({TASK: DUE})
    _schedule_soon(lab, "archive-Hourly")
    # The function logs the task; with JSON its quotes have a backslash.
    called = until(
        lambda: any(task in line.replace("\\", "") for line in lab.lines(function, began_ms)),
        "the archive's function, called by its schedule",
        within_s=_WITHIN_S,
    )
    return {"called": called}


@question(
    "schedules.analysis",
    aws="scheduler:schedule-types scheduler:managing-targets-templated",
    expected={"runs": 1, "input_as_scheduled": True},
)
def analysis_scheduled(lab: Lab) -> Seen:
    """A one-time copy of the nightly schedule starts one execution of the analysis, by the schedule's role
    and with its input. The question ends it again."""
    client, machine = lab.client("stepfunctions"), lab.cloud.output("analysis", "AnalysisMachine")

    def runs() -> set[str]:
        return {run["executionArn"] for run in client.list_executions(stateMachineArn=machine)["executions"]}

    before = runs()
    scheduled = _schedule_soon(lab, "analysis-Nightly")
    new = until(lambda: runs() - before, "the analysis, started by its schedule", within_s=_WITHIN_S)
    started = [client.describe_execution(executionArn=run) for run in new]
    for run in started:
        if run["status"] == "RUNNING":
            client.stop_execution(executionArn=run["executionArn"])
    same = [json.loads(run["input"]) for run in started] == [json.loads(scheduled["Input"])]
    return {"runs": len(started), "input_as_scheduled": same}
