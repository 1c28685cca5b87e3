"""Probes of PubNub and CloudWatch."""

from __future__ import annotations

import json
import time
import uuid
from contextlib import ExitStack
from datetime import datetime, timedelta, timezone
from typing import Any

from bench.probes.probe_fixture import WAIT_S, AbilityMissingError, ProbeFixture, equal, until
from iort_contract.topics import LAMBDA

LISTENERS = 4


def live_sample(fixture: ProbeFixture) -> str:
    """A live sample reaches a subscriber."""
    with fixture.target.listener(fixture.a) as listener, fixture.client(0) as client:
        fixture.live_until(client, lambda: listener.heard, "the subscriber to hear a sample")
        return f"a live sample came to a subscriber after {listener.heard[0].delay_ms:.0f} ms"


def many_subscribers(fixture: ProbeFixture) -> str:
    """The same message reaches several subscribers."""
    with ExitStack() as stack:
        listeners = [stack.enter_context(fixture.target.listener(fixture.a)) for _ in range(LISTENERS)]
        fixture.live_until(
            stack.enter_context(fixture.client(0)),
            lambda: all(listener.heard for listener in listeners),
            "all subscribers to hear a sample",
        )
    return f"all {LISTENERS} heard one message"


def metrics(fixture: ProbeFixture) -> str:
    """CloudWatch returns the mean of the values of a metric."""
    client, now = fixture.cloud.client("cloudwatch"), datetime.now(timezone.utc)
    name = f"Bench{uuid.uuid4().hex[:8]}"
    values = {"Values": [1.0, 2.0, 6.0], "Counts": [1.0, 1.0, 1.0]}
    client.put_metric_data(
        Namespace="iort-bench", MetricData=[{"MetricName": name, "Timestamp": now, **values}]
    )
    found: list[dict[str, Any]] = []

    def there() -> bool:
        found[:] = client.get_metric_statistics(
            Namespace="iort-bench",
            MetricName=name,
            StartTime=now - timedelta(minutes=5),
            EndTime=now + timedelta(minutes=5),
            Period=60,
            Statistics=["Average", "SampleCount"],
        )["Datapoints"]
        return bool(found)

    until(there, "the metric's statistics", 180 if fixture.target.embedded is None else WAIT_S)
    equal(round(found[0]["Average"], 6), 3.0)
    return "the mean of 1, 2 and 6 came back as 3"


def logs(fixture: ProbeFixture) -> str:
    """The log has the lines of an invocation."""
    function = fixture.cloud.output("processing", "EchoFunction")
    client = fixture.cloud.client("lambda")
    group = client.get_function_configuration(FunctionName=function)["LoggingConfig"]["LogGroup"]
    since = int(time.time() * 1000) - 1000
    fixture.pong(LAMBDA)
    logs = fixture.cloud.client("logs")
    until(
        lambda: bool(logs.filter_log_events(logGroupName=group, startTime=since)["events"]),
        "the log's lines",
    )
    return "an invocation's lines are in its log"


def dashboards(fixture: ProbeFixture) -> str:
    """The deployment has dashboards with widgets."""
    client = fixture.cloud.client("cloudwatch")
    names = [entry["DashboardName"] for entry in client.list_dashboards()["DashboardEntries"]]
    if not names:
        raise AbilityMissingError("there is no dashboard")
    widgets = sum(
        len(json.loads(client.get_dashboard(DashboardName=name)["DashboardBody"])["widgets"])
        for name in names
    )
    return f"{len(names)} dashboards of {widgets} widgets"
