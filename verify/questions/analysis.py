"""The state machine of the analysis, and the schedules that call it and the archive."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
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
from testkit.target import EMBEDDED, Target
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools import batch, lines, registered, send, stored

_GUIDE = "https://docs.aws.amazon.com/step-functions/latest/dg"
_API = "https://docs.aws.amazon.com/step-functions/latest/apireference"
_STATES = "stacks/states.py"
_SAMPLES = 30
_DAY_US = 86_400_000_000


def _driven(target: Target, base: str) -> str:
    """The name of a new robot that has just driven for half a minute."""
    bundle, first_us = target.robot(base), int(time.time() - 2 * _SAMPLES) * 1_000_000
    send(target, bundle, *(batch(number, first_us=first_us) for number in range(_SAMPLES)))
    stored(target, bundle.robot, _SAMPLES)
    return bundle.robot


def _started(target: Target, *robots: str, days_ago: int = 0) -> str:
    """Start a run over a day of these robots, or of all."""
    end_us = time.time_ns() // 1000 - days_ago * _DAY_US
    return analysis.start(target.cloud, AnalysisRequest(robots, end_us - _DAY_US, end_us))


def _ended(target: Target, run: str) -> Progress:
    """The end of a run; raises `StationError` if it fails."""
    *_, last = analysis.watch(target.cloud, run)
    return last


def _analysed(target: Target, robot: str) -> list[int]:
    """The samples of each analysed drive of the robot."""
    return [one.samples for one in findings.drives(target.cloud, robot)]


def _failed(target: Target, robot: str) -> int:
    """The number of the robot's findings that its drive could not be analysed."""
    return sum(one.kind == ANALYSIS_FAILED for one in findings.findings(target.cloud, robot))


@contextmanager
def _broken(target: Target, name: str) -> Iterator[None]:
    """Take a function's variables away, without which it raises; give them back at the end."""
    client = target.cloud.client("lambda")
    variables = client.get_function_configuration(FunctionName=name)["Environment"]["Variables"]

    def change(those: dict[str, str]) -> None:
        client.update_function_configuration(FunctionName=name, Environment={"Variables": those})
        client.get_waiter("function_updated_v2").wait(FunctionName=name)

    change({})
    try:
        yield
    finally:
        change(variables)


@question(
    "analysis.no_robot",
    expected={"state": SUCCEEDED, "drives": 0, "findings": 0},
    source=f"{_GUIDE}/state-map-inline.html",
    relied_on_by=(_STATES, "functions/plan.py"),
)
def no_robot(target: Target) -> Seen:
    """A run of all robots ends well where there is none. It is the first question, so that a new deployment
    has none; in an older one the run is of a day on which nobody drove."""
    last = _ended(target, _started(target, days_ago=3650))
    return {
        "state": last.state,
        "drives": last.drives or 0,
        "findings": last.findings,
        "note_robots": len(list(registry.listed(target.cloud))),
    }


@question(
    "analysis.empty_plan",
    expected={"state": SUCCEEDED, "drives": 0, "findings": 0},
    source=f"{_GUIDE}/input-output-itemreader.html",
    relied_on_by=(_STATES, "functions/plan.py", "functions/evaluate.py"),
)
def empty_plan(target: Target) -> Seen:
    """A run of a robot that has never driven ends well. AWS does not document what its reader of objects
    (LOAD_AND_FLATTEN) does if they hold no item."""
    last = _ended(target, _started(target, registered(target, "verify-victim").robot))
    return {"state": last.state, "drives": last.drives or 0, "findings": last.findings}


@question(
    "analysis.one_drive",
    expected={"state": SUCCEEDED, "drives": 1, "done": 1, "samples": [_SAMPLES], "failed": 0},
    source=f"{_GUIDE}/state-map-distributed.html and {_GUIDE}/iam-policies-eg-dist-map.html",
    relied_on_by=(_STATES, "stacks/analysis.py", "functions/analyse.py"),
)
def one_drive(target: Target) -> Seen:
    """The distributed map reads the plan's drive from the bucket and starts a child execution for it, with
    the rights that AWS lists for such a map. The drive's result is in the table at the end."""
    robot = _driven(target, "verify-drive")
    last = _ended(target, _started(target, robot))
    return {
        "state": last.state,
        "drives": last.drives,
        "done": last.done,
        "samples": _analysed(target, robot),
        "failed": _failed(target, robot),
    }


@question(
    "analysis.failing_drive",
    expected={"state": SUCCEEDED, "failed": 1, "next": SUCCEEDED, "failed_then": 0, "samples": [_SAMPLES]},
    source=f"{_GUIDE}/concepts-error-handling.html",
    relied_on_by=(_STATES, "functions/present.py", "functions/shared/analysis.py"),
)
def failing_drive(target: Target) -> Seen:
    """A drive whose function raises at each attempt becomes a finding, and the run ends well. The next run
    analyses the drive and removes the finding."""
    robot = _driven(target, "verify-fails")
    with _broken(target, target.cloud.output("analysis", "AnalyseFunction")):
        state, failed = _ended(target, _started(target, robot)).state, _failed(target, robot)
    # The next run plans the drive again, because it has no result.
    then = _ended(target, _started(target, robot))
    return {
        "state": state,
        "failed": failed,
        "next": then.state,
        "failed_then": _failed(target, robot),
        "samples": _analysed(target, robot),
    }


@question(
    "analysis.stopped",
    expected={"stopped": "ABORTED", "watched": True, "next": SUCCEEDED, "samples": [_SAMPLES]},
    source=f"{_API}/API_StopExecution.html and {_GUIDE}/redrive-map-run.html",
    relied_on_by=("station/iort_station/operations/analysis.py", _STATES, "functions/plan.py"),
)
def stopped(target: Target) -> Seen:
    """A run that is stopped midway is ABORTED, which `iort analyse` reports. Children of its map may go on,
    and do no harm: the next run analyses the drive, once."""
    robot, client = _driven(target, "verify-stopped"), target.cloud.client("stepfunctions")
    run = _started(target, robot)
    until(
        lambda: client.get_execution_history(executionArn=run, maxResults=10)["events"][2:],
        "the first work of a run",
        poll_s=0.05,
    )
    client.stop_execution(executionArn=run)
    try:
        watched = _ended(target, run).state
    except StationError as error:
        watched = str(error)
    then = _ended(target, _started(target, robot))
    return {
        "stopped": client.describe_execution(executionArn=run)["status"],
        "watched": "the analysis has ended: aborted" in watched,
        "next": then.state,
        "samples": _analysed(target, robot),
        "note_drives_of_the_next": then.drives,
    }


_SCHEDULER = "https://docs.aws.amazon.com/scheduler/latest/UserGuide"
# AWS calls within 60 s of the time.
_AHEAD_S, _EMBEDDED_AHEAD_S, _WITHIN_S = 60, 1, 240.0


@contextmanager
def _soon(target: Target, schedule: str) -> Iterator[dict[str, Any]]:
    """A copy of a deployed schedule that calls the same target once, soon; yields the target."""
    client, prefix = target.cloud.client("scheduler"), f"{target.cloud.namespace}-{schedule}"
    (name,) = [one["Name"] for one in client.list_schedules(NamePrefix=prefix)["Schedules"]]
    found = client.get_schedule(Name=name)
    ahead_s = _EMBEDDED_AHEAD_S if target.kind == EMBEDDED else _AHEAD_S
    at = datetime.now(timezone.utc) + timedelta(seconds=ahead_s)
    copy = target.name("verify-schedule")
    client.create_schedule(
        Name=copy,
        ScheduleExpression=f"at({at:%Y-%m-%dT%H:%M:%S})",
        FlexibleTimeWindow=found["FlexibleTimeWindow"],
        Target=found["Target"],
        ActionAfterCompletion="DELETE",
    )
    try:
        yield found["Target"]
    finally:
        with suppress(client.exceptions.ResourceNotFoundException):
            client.delete_schedule(Name=copy)


@question(
    "schedules.archive",
    expected={"called": True},
    source=f"{_SCHEDULER}/schedule-types.html and {_SCHEDULER}/setting-up.html",
    relied_on_by=("stacks/parts.py", "stacks/archive.py"),
)
def archive_scheduled(target: Target) -> Seen:
    """A one-time copy of the archive's hourly schedule calls the function, by the schedule's role and with
    its input, within a minute of its time."""
    function, began_ms = target.cloud.output("archive", "ArchiveFunction"), int(time.time() * 1000)
    said = json.dumps({TASK: DUE})
    with _soon(target, "archive-Hourly"):
        # The function logs the task; with JSON its quotes have a backslash.
        called = until(
            lambda: any(said in line.replace("\\", "") for line in lines(target, function, began_ms)),
            "the archive's function, called by its schedule",
            within_s=_WITHIN_S,
        )
    return {"called": called}


@question(
    "schedules.analysis",
    expected={"runs": 1, "input_as_scheduled": True},
    source=f"{_SCHEDULER}/schedule-types.html and {_SCHEDULER}/managing-targets-templated.html",
    relied_on_by=("stacks/analysis.py",),
)
def analysis_scheduled(target: Target) -> Seen:
    """A one-time copy of the nightly schedule starts one execution of the analysis, by the schedule's role
    and with its input. The question ends it again."""
    client, machine = target.cloud.client("stepfunctions"), target.cloud.output("analysis", "AnalysisMachine")

    def runs() -> set[str]:
        return {one["executionArn"] for one in client.list_executions(stateMachineArn=machine)["executions"]}

    before = runs()
    with _soon(target, "analysis-Nightly") as scheduled:
        made = until(lambda: runs() - before, "the analysis, started by its schedule", within_s=_WITHIN_S)
    given = [client.describe_execution(executionArn=run) for run in made]
    for run in given:
        if run["status"] == "RUNNING":
            client.stop_execution(executionArn=run["executionArn"])
    return {
        "runs": len(given),
        "input_as_scheduled": [json.loads(one["input"]) for one in given] == [json.loads(scheduled["Input"])],
    }
