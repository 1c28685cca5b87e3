"""What of a `Usage` a deployment says itself."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from iort_station.cloud import Cloud
from iort_station.cost.usage import Usage
from iort_station.operations import cloudwatch

_INSIGHTS = re.compile(r'SELECT SUM\((?P<metric>\w+)\) FROM "(?P<namespace>[\w/]+)"')


def as_deployed(usage: Usage, cloud: Cloud) -> Usage:
    """Memory, concurrency, logs, alarms, dashboards, recovery and key as they are deployed; alarms and
    dashboards are all of the account, since so are CloudWatch's allowances."""
    return replace(usage, **_functions(cloud), **_watching(cloud), **_tables(cloud))


def _functions(cloud: Cloud) -> dict[str, Any]:
    found: dict[str, Any] = {}
    client = cloud.client("lambda")
    for name, key in (("Live", "live_memory_mb"), ("Summarize", "summarize_memory_mb")):
        function = cloud.output("processing", f"{name}Function")
        configured = client.get_function_configuration(FunctionName=function)
        found[key] = configured["MemorySize"]
        if name == "Live":
            reserved = client.get_function_concurrency(FunctionName=function)
            level = configured.get("LoggingConfig", {}).get("SystemLogLevel")
            found["function_logs"] = "own" if level == "WARN" else "all"
            found["live_concurrency"] = reserved.get("ReservedConcurrentExecutions", 0)
    return found


def _watching(cloud: Cloud) -> dict[str, Any]:
    client = cloud.client("cloudwatch")
    pages = client.get_paginator("describe_alarms").paginate()
    alarms = [alarm for page in pages for alarm in page.get("MetricAlarms", [])]
    queries = [query for alarm in alarms if (query := _insights(alarm))]
    names = cloudwatch.dashboards(cloud)
    # Ours, the robots' last, where `at_rest` counts what its searches find.
    names.sort(key=lambda name: name == f"{cloud.namespace}-robots")
    counted = [cloudwatch.count(cloudwatch.body_of(cloud, name)) for name in names]
    return {
        "alarms": len(alarms) - len(queries),
        "insights_metrics": sum(_metrics(client, query) for query in queries),
        "dashboards": tuple(one.metrics for one in counted),
        "robot_metrics": bool(counted and counted[-1].searches),
    }


def _insights(alarm: Mapping[str, Any]) -> re.Match[str] | None:
    return next(
        (
            found
            for query in alarm.get("Metrics", [])
            if (found := _INSIGHTS.match(query.get("Expression", "")))
        ),
        None,
    )


def _metrics(client: Any, query: re.Match[str]) -> int:
    """How many metrics there are that a query analyses."""
    pages = client.get_paginator("list_metrics").paginate(
        Namespace=query["namespace"], MetricName=query["metric"], RecentlyActive="PT3H"
    )
    return sum(len(page["Metrics"]) for page in pages)


def _tables(cloud: Cloud) -> dict[str, Any]:
    table, dynamodb = cloud.output("storage", "TelemetryTable"), cloud.client("dynamodb")
    encryption = dynamodb.describe_table(TableName=table)["Table"].get("SSEDescription", {})
    backups = dynamodb.describe_continuous_backups(TableName=table)["ContinuousBackupsDescription"]
    recovery = backups.get("PointInTimeRecoveryDescription", {})
    return {
        "customer_key": encryption.get("SSEType") == "KMS",
        "recoverable": recovery.get("PointInTimeRecoveryStatus") == "ENABLED",
    }
