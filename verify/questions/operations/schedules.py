"""EventBridge Scheduler: the schedules call their targets, with their own role and input."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta, timezone
from typing import Any

from iort_contract.archive import DUE, TASK
from testkit.target import EMBEDDED, Target
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools.logs import lines

_GUIDE = "https://docs.aws.amazon.com/scheduler/latest/UserGuide"
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
    source=f"{_GUIDE}/schedule-types.html and {_GUIDE}/setting-up.html",
    relied_on_by=("stacks/parts.py", "stacks/archive.py"),
)
def archive(target: Target) -> Seen:
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
    source=f"{_GUIDE}/schedule-types.html and {_GUIDE}/managing-targets-templated.html",
    relied_on_by=("stacks/analysis.py",),
)
def analysis(target: Target) -> Seen:
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
