"""The functions' output: lines that become metrics, and lines that the dashboard shows as warnings."""

from __future__ import annotations

import re
import time
from datetime import datetime, timedelta, timezone

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE
from testkit.target import Target, configure, temporary_function
from testkit.waiting import InstrumentError, until
from verify.question import Seen, question
from verify.tools.telemetry import batch, send

_CLOUDWATCH = "https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring"
_GUIDE = "https://docs.aws.amazon.com/lambda/latest/dg"
_METRIC, _FUNCTION = "BatchesSummarized", "summarize"
_WITHIN_S = 170.0
# The filter of the log widget in stacks/monitoring.py.
_SHOWN = re.compile("WARN|ERROR|CRITICAL|FATAL|Traceback|Task timed out")
_WARNED, _RAISED, _PRINTED = "verify warned", "verify raised", "verify printed"
_SPEAKING = f"""
import logging

def handler(event, context):
    print("{_PRINTED}")
    logging.getLogger(__name__).warning("{_WARNED}")
    raise RuntimeError("{_RAISED}")
"""


def _counted(target: Target, since: datetime) -> float:
    """The number of batches that Lambda 2 has summarised since then, by its metric."""
    dimensions = {METRIC_DEPLOYMENT: target.cloud.namespace, METRIC_FUNCTION: _FUNCTION}
    metric = {
        "Namespace": METRIC_NAMESPACE,
        "MetricName": _METRIC,
        "Dimensions": [{"Name": name, "Value": value} for name, value in dimensions.items()],
    }
    answer = target.cloud.client("cloudwatch").get_metric_data(
        MetricDataQueries=[{"Id": "q", "MetricStat": {"Metric": metric, "Period": 60, "Stat": "Sum"}}],
        StartTime=since,
        EndTime=datetime.now(timezone.utc) + timedelta(minutes=2),
    )
    return float(sum(value for result in answer["MetricDataResults"] for value in result["Values"]))


@question(
    "logs.metric",
    expected={"counted": True},
    source=f"{_CLOUDWATCH}/CloudWatch_Embedded_Metric_Format_Specification.html and "
    f"{_GUIDE}/monitoring-cloudwatchlogs-log-level.html",
    relied_on_by=(
        "functions/shared/metrics.py",
        "stacks/parts.py",
        "stacks/monitoring.py",
        "local/emulator/fixes/metrics.py",
    ),
)
def metric(target: Target) -> Seen:
    """If a function prints a line in the embedded metric format, with logs in JSON and the level INFO, it
    becomes a metric with our dimensions within three minutes."""
    bundle, cloud = target.robot("verify-metric"), target.cloud
    configuration = cloud.client("lambda").get_function_configuration(
        FunctionName=cloud.output("processing", "SummarizeFunction")
    )
    logging = configuration.get("LoggingConfig", {})
    since = datetime.now(timezone.utc).replace(second=0, microsecond=0) - timedelta(minutes=15)
    before = _counted(target, since)
    send(target, bundle, batch())
    began = time.monotonic()
    try:
        counted = until(lambda: _counted(target, since) > before, _METRIC, within_s=_WITHIN_S)
    except InstrumentError:
        counted = False
    return {
        "counted": counted,
        "note_logging": {name: logging[name] for name in sorted(logging) if name != "LogGroup"},
        "note_after_s": round(time.monotonic() - began),
    }


@question(
    "logs.lines",
    expected={"printed_as_it_is": True, "warning_is_shown": True, "failure_is_shown": True},
    relied_on_by=(
        "stacks/monitoring.py",
        "functions/shared/metrics.py",
        "station/iort_station/operations/cloudwatch.py",
        "local/patches/log_records.patch",
    ),
)
def lines(target: Target) -> Seen:
    """With logs in JSON, printed lines stay unchanged; warnings and uncaught errors are lines with their
    level, which the dashboard's log widget finds."""
    client, logs = target.cloud.client("lambda"), target.cloud.client("logs")
    model = client.get_function_configuration(FunctionName=target.cloud.output("processing", "EchoFunction"))
    group = model["LoggingConfig"]["LogGroup"]
    began_ms = int(time.time() * 1000)
    with temporary_function(target, "speaking", _SPEAKING, memory_mb=128) as name:
        configure(client, name, LoggingConfig=model["LoggingConfig"])
        client.invoke(FunctionName=name, Payload=b"{}")

        def said() -> list[str] | None:
            """The lines of the function's environment, once the last one is there."""
            pages = logs.get_paginator("filter_log_events").paginate(logGroupName=group, startTime=began_ms)
            events = [event for page in pages for event in page["events"]]
            ours = {event["logStreamName"] for event in events if _RAISED in event["message"]}
            return [event["message"].strip() for event in events if event["logStreamName"] in ours]

        lines = until(said, "the lines in the function's log")
    return {
        "printed_as_it_is": _PRINTED in lines,
        "warning_is_shown": any(_WARNED in line and _SHOWN.search(line) for line in lines),
        # An error may have several lines, and only one has its level.
        "failure_is_shown": any(_WARNED not in line and _SHOWN.search(line) for line in lines),
        "note_failure_in_json": any(_RAISED in line and line.startswith("{") for line in lines),
    }
