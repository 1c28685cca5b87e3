"""Runs of the analysis: the state machine is started here, and watched."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from botocore.exceptions import ClientError

from iort_contract.messages.analysis import AnalysisRequest, encode_request
from iort_station.cloud import Cloud
from iort_station.errors import StationError

RUNNING, SUCCEEDED = "RUNNING", "SUCCEEDED"
_POLL_S = 1.0


@dataclass(frozen=True)
class Progress:
    """How far a run is. ``drives`` is None until they are found; ``findings`` are known at its end."""

    state: str
    drives: int | None = None
    done: int = 0
    findings: int = 0


def start(cloud: Cloud, request: AnalysisRequest) -> str:
    """Start a run; returns its ARN, whose last part is the run's name."""
    machine = cloud.output("analysis", "AnalysisMachine")
    try:
        answer = cloud.client("stepfunctions").start_execution(
            stateMachineArn=machine, name=f"iort-{uuid.uuid4()}", input=json.dumps(encode_request(request))
        )
    except ClientError as error:
        raise StationError(f"the analysis cannot be started: {error}") from error
    return str(answer["executionArn"])


def named(cloud: Cloud, name: str) -> str:
    """The ARN of a run by its name."""
    machine = cloud.output("analysis", "AnalysisMachine")
    return f"{machine.replace(':stateMachine:', ':execution:')}:{name}"


def watch(cloud: Cloud, run: str) -> Iterator[Progress]:
    """The progress of a run, every second until its end; raises `StationError` if it fails."""
    while True:
        found = look(cloud, run)
        yield found
        if found.state != RUNNING:
            return
        time.sleep(_POLL_S)


def look(cloud: Cloud, run: str) -> Progress:
    """The progress of a run now; raises `StationError` if it has failed, or if there is no such run."""
    client = cloud.client("stepfunctions")
    try:
        described = client.describe_execution(executionArn=run)
    except ClientError as error:
        raise StationError(f"the analysis {run.rpartition(':')[2]} cannot be read: {error}") from error
    state = described["status"]
    counts = _counts(client, run)
    if state == RUNNING:
        return Progress(state, *counts)
    if state != SUCCEEDED:
        reason = described.get("cause") or described.get("error") or state
        raise StationError(f"the analysis has ended: {state.lower()}: {reason}")
    return Progress(state, *counts, findings=_sum(json.loads(described["output"])["findings"]))


def _sum(findings: Any) -> int:
    """The findings of a run: a number a robot. A robot whose step failed for good may have none."""
    numbers = findings if isinstance(findings, list) else [findings]
    return sum(one for one in numbers if isinstance(one, int))


def _counts(client: Any, run: str) -> tuple[int | None, int]:
    """The drives of a run, and how many are done."""
    runs = (one["mapRunArn"] for one in client.list_map_runs(executionArn=run)["mapRuns"])
    # The ARN of a map's run has its label ("Map Run").
    drives = next((arn for arn in runs if "/Drives:" in arn), None)
    if drives is None:
        return None, 0
    counts = client.describe_map_run(mapRunArn=drives)["itemCounts"]
    return int(counts["total"]), int(counts["succeeded"] + counts["failed"])
