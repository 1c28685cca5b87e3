"""One embedded cloud for all tests of this folder, deployed as `make demo` deploys it."""

from __future__ import annotations

import gc
import json
import re
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from iort_station import data
from iort_station.cli.main import app
from iort_station.cloud import EMBEDDED
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from testkit.ports import free_port
from testkit.waiting import until


@pytest.fixture(scope="session")
def embedded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedCloud]:
    ports = {name: free_port() for name in ("gateway", "mqtt", "pubnub")}
    with EmbeddedCloud(tmp_path_factory.mktemp("cloud") / "local", ports=ports) as cloud:
        yield cloud


@pytest.fixture(autouse=True, scope="module")
def sockets_of_other_libraries() -> Iterator[None]:
    """Some clients leave their sockets to the garbage collector. It runs here, because the warning would
    fail an unrelated test."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@pytest.fixture
def bundle(
    embedded: EmbeddedCloud, tmp_path: Path, request: pytest.FixtureRequest
) -> Callable[..., robots.Bundle]:
    """Register a robot for each test: `bundle("a", sources=[...])`."""

    def register(suffix: str = "", **settings: Any) -> robots.Bundle:
        # The end of the name tells parametrized cases apart.
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", f"{request.node.name}{suffix}")[-50:].strip("-")
        return robots.add(embedded.cloud, name, out=tmp_path, settings=settings)

    return register


@pytest.fixture
def inbox(embedded: EmbeddedCloud) -> Iterator[Callable[[], list[Any]]]:
    """Collect the messages to the subscribers of the alarm topic."""
    cloud = embedded.cloud
    topic, sqs = cloud.output("processing", "AlarmTopic"), cloud.client("sqs")
    url = sqs.create_queue(QueueName=f"inbox-{time.time_ns()}")["QueueUrl"]
    arn = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["QueueArn"])["Attributes"]["QueueArn"]
    statement: dict[str, Any] = {
        "Effect": "Allow",
        "Principal": {"Service": "sns.amazonaws.com"},
        "Action": "sqs:SendMessage",
        "Resource": arn,
        "Condition": {"ArnEquals": {"aws:SourceArn": topic}},
    }
    policy = json.dumps({"Version": "2012-10-17", "Statement": [statement]})
    sqs.set_queue_attributes(QueueUrl=url, Attributes={"Policy": policy})
    subscription = cloud.client("sns").subscribe(TopicArn=topic, Protocol="sqs", Endpoint=arn)
    got: list[Any] = []

    def received() -> list[Any]:
        answer = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10, WaitTimeSeconds=1)
        for message in answer.get("Messages", []):
            got.append(json.loads(message["Body"]))
            sqs.delete_message(QueueUrl=url, ReceiptHandle=message["ReceiptHandle"])
        return got

    yield received
    cloud.client("sns").unsubscribe(SubscriptionArn=subscription["SubscriptionArn"])
    sqs.delete_queue(QueueUrl=url)


@pytest.fixture
def iort(embedded: EmbeddedCloud) -> Callable[..., Any]:
    """The operator's command: `iort("robots", "list")`."""

    return partial(invoke, embedded.folder)


def invoke(folder: Path, *arguments: str) -> Any:
    """The operator's command for the cloud that a folder describes."""
    where = ["--local", "--embedded", str(folder / EMBEDDED.name)]
    return CliRunner().invoke(app, [*where, *arguments])


AGENT = Path(sys.executable).parent / "iort-agent"


def command(*arguments: object, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the installed agent's command to its end, with that exit status."""
    done = subprocess.run(
        [AGENT, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


def run_agent(bundle: robots.Bundle) -> dict[str, Any]:
    """Run the installed agent to the end of its sources; return its report."""
    report = bundle.folder / "report.json"
    command("--config", bundle.config, "--report", report)
    written: dict[str, Any] = json.loads(report.read_text())
    return written


def fire(embedded: EmbeddedCloud, name: str) -> None:
    """Let EventBridge Scheduler call what a deployed schedule calls, once, now: `fire(embedded,
    "archive-Hourly")`. It looks every ten seconds."""
    client = embedded.cloud.client("scheduler")
    names = [one["Name"] for one in client.list_schedules()["Schedules"]]
    (found,) = [one for one in names if one.startswith(f"{embedded.namespace}-{name}-")]
    schedule = client.get_schedule(Name=found)
    assert schedule["State"] == "ENABLED"
    client.create_schedule(
        Name=f"{found}-now",
        ScheduleExpression=f"at({datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%S})",
        FlexibleTimeWindow=schedule["FlexibleTimeWindow"],
        Target=schedule["Target"],
        ActionAfterCompletion="DELETE",
    )


def recorded(embedded: EmbeddedCloud, robot: str, stream: str) -> data.Result:
    """The stream's samples, as soon as there are some: a query of an unknown stream is an error."""
    until(lambda: list(audit.batches(embedded.cloud, robot, stream)))
    return data.query(embedded.cloud, robot, stream, "-1h", "now")
