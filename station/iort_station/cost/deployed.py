"""The settings of a deployment that make its bill."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from iort_station.cloud import Cloud
from iort_station.cost.usage import Usage
from iort_station.fleet.roles import transport
from iort_station.operations import cloudwatch

_INSIGHTS = re.compile(r'SELECT SUM\((?P<metric>\w+)\) FROM "(?P<namespace>[\w/]+)"')


def as_deployed(usage: Usage, cloud: Cloud) -> Usage:
    """The usage with live messages, memory, concurrency, logs, alarms, dashboards, recovery and key as
    deployed.

    Alarms and dashboards are the whole account's, like CloudWatch's free allowances.
    """
    deployed = {**_functions(cloud), **watching(cloud), **_tables(cloud)}
    return replace(usage, live_transport=transport(cloud), **deployed)


def _functions(cloud: Cloud) -> dict[str, Any]:
    client = cloud.client("lambda")
    names = [cloud.output("processing", f"{name}Function") for name in ("Live", "Summarize")]
    live, summarize = (client.get_function_configuration(FunctionName=name) for name in names)
    reserved = client.get_function_concurrency(FunctionName=names[0])
    level = live.get("LoggingConfig", {}).get("SystemLogLevel")
    return {
        "live_memory_mb": live["MemorySize"],
        "summarize_memory_mb": summarize["MemorySize"],
        "function_logs": "own" if level == "WARN" else "all",
        "live_concurrency": reserved.get("ReservedConcurrentExecutions", 0),
    }


def watching(cloud: Cloud) -> dict[str, Any]:
    """The alarms and dashboards."""
    client = cloud.client("cloudwatch")
    pages = client.get_paginator("describe_alarms").paginate()
    alarms = [alarm for page in pages for alarm in page.get("MetricAlarms", [])]
    matches = (
        [_INSIGHTS.match(query.get("Expression", "")) for query in alarm.get("Metrics", [])]
        for alarm in alarms
    )
    queries = [query for query in (next(filter(None, found), None) for found in matches) if query]
    # The robots' dashboard comes last, where `dashboard_metrics` counts what its searches find.
    names = sorted(cloudwatch.dashboards(cloud), key=lambda name: name == f"{cloud.namespace}-robots")
    counted = [cloudwatch.count(cloudwatch.body_of(cloud, name)) for name in names]
    return {
        "alarms": len(alarms) - len(queries),
        "insights_metrics": sum(_metrics(client, query) for query in queries),
        "dashboards": tuple(one.metrics for one in counted),
        "robot_metrics": bool(counted and counted[-1].searches),
    }


def _metrics(client: Any, query: re.Match[str]) -> int:
    """The number of metrics that a query analyses."""
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
