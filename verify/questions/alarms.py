"""Alarms, alerts and what they rest on: notices reach a person, and printed lines become metrics."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE
from iort_contract.catalog.vesc import FAULT_FIELD, VESC_STREAM
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.messages.page import AlarmEntry
from iort_contract.topics import LIVE, build_topic
from iort_station.operations import alarms
from testkit.mqtt import Robot
from testkit.target import Target, configure, temporary_function
from testkit.waiting import InstrumentError, until
from verify.question import CHANGED, Seen, question
from verify.tools import RUN, batch, inbox, send

_REASON = "verify: does it notify?"
_ALARM = "ALARM"
_FAULT = 5
# With every character that a tag's value may have, beside letters and digits.
_BY = "verify +-=._:/@"
# The alarms that use Metrics Insights: stacks/monitoring.py.
_INSIGHTS = ("ParseError", "ErrorActionFailure", "RuleMessageThrottled", "DestinationDeliveryFailures")


def _quiet_alarm(target: Target) -> dict[str, Any]:
    """An alarm of the deployment that is not in ALARM: only a change of state sends a notice."""
    pages = target.cloud.client("cloudwatch").get_paginator("describe_alarms")
    for page in pages.paginate(AlarmNamePrefix=f"{target.cloud.namespace}-", AlarmTypes=["MetricAlarm"]):
        for alarm in page["MetricAlarms"]:
            if alarm["StateValue"] != _ALARM:
                return dict(alarm)
    raise InstrumentError("every alarm of the deployment is in ALARM")


_NOTIFIED = {
    "topic_has_key": False,
    "type": "Notification",
    "subject_names_alarm": True,
    "alarm": True,
    "description": True,
    "new_state": _ALARM,
    "old_state": True,
    "reason": _REASON,
}


@question(
    "alarms.set_state",
    expected=_NOTIFIED,
    source="https://docs.aws.amazon.com/AmazonCloudWatch/latest/APIReference/API_SetAlarmState.html",
    relied_on_by=("stacks/monitoring.py", "stacks/processing.py"),
)
def set_state(target: Target) -> Seen:
    """An alarm whose state is set to ALARM notifies the alarm topic, and the topic its subscribers, with
    name, description, both states and the reason."""
    cloud = target.cloud
    topic, alarm = cloud.output("processing", "AlarmTopic"), _quiet_alarm(target)
    name, cloudwatch = alarm["AlarmName"], cloud.client("cloudwatch")

    def ours(mail: dict[str, Any]) -> bool:
        return mail.get("Subject", "").startswith(_ALARM) and _REASON in mail["Message"]

    with inbox(target, topic) as receive:
        cloudwatch.set_alarm_state(AlarmName=name, StateValue=_ALARM, StateReason=_REASON)
        try:
            mail = receive(ours, "the alarm at the topic's subscriber")
        finally:
            cloudwatch.set_alarm_state(
                AlarmName=name, StateValue=alarm["StateValue"], StateReason=alarm.get("StateReason", "")
            )
    told = json.loads(mail["Message"])
    attributes = cloud.client("sns").get_topic_attributes(TopicArn=topic)["Attributes"]
    return {
        "topic_has_key": bool(attributes.get("KmsMasterKeyId")),
        "type": mail["Type"],
        "subject_names_alarm": name in mail["Subject"],
        "alarm": told["AlarmName"] == name,
        "description": told["AlarmDescription"] == alarm["AlarmDescription"],
        "new_state": told["NewStateValue"],
        "old_state": told["OldStateValue"] == alarm["StateValue"],
        "reason": told["NewStateReason"],
    }


@question(
    "alarms.acknowledged",
    expected={"by": _BY, "kept": True},
    source="https://docs.aws.amazon.com/AmazonCloudWatch/latest/APIReference/API_TagResource.html",
    relied_on_by=("station/iort_station/operations/alarms.py",),
)
def acknowledged(target: Target) -> Seen:
    """A raised alarm takes a tag that says who has seen it and when, and keeps it."""
    cloud, alarm = target.cloud, _quiet_alarm(target)
    name, cloudwatch = alarm["AlarmName"], cloud.client("cloudwatch")

    def entry() -> AlarmEntry:
        return next(one for one in alarms.alarms(cloud) if one["name"] == name)

    cloudwatch.set_alarm_state(AlarmName=name, StateValue=_ALARM, StateReason=_REASON)
    try:
        raised = entry()
        seen = alarms.acknowledge(cloud, raised["key"], raised["since_s"], _BY)
        kept = entry()["acknowledged"]
    finally:
        cloudwatch.set_alarm_state(
            AlarmName=name, StateValue=alarm["StateValue"], StateReason=alarm.get("StateReason", "")
        )
    same = kept is not None and abs(kept["at_s"] - seen["at_s"]) < 0.01
    return {"by": kept["by"] if kept else None, "kept": same}


set_state_with_key = replace(
    set_state,
    name="alarms.set_state_with_key",
    assumed=(
        "The same with a topic encrypted with the account's own key, which admits CloudWatch "
        "without a condition."
    ),
    expected={**_NOTIFIED, "topic_has_key": True},
    source="https://repost.aws/knowledge-center/cloudwatch-configure-alarm-sns",
    relied_on_by=("stacks/parts.py",),
    phase=CHANGED,
    not_embedded="the embedded cloud is deployed without a key: its topics encrypt nothing",
)


@question(
    "alarms.metrics_insights",
    expected={
        "alarms": len(_INSIGHTS),
        "evaluation": ["as it should"],
        "queries": ["Complete"] * len(_INSIGHTS),
        "messages": [],
    },
    source="https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/alarm-evaluation.html",
    relied_on_by=("stacks/monitoring.py", "stacks/monitoring.py"),
    not_embedded="the embedded cloud has no Metrics Insights, and is deployed without these alarms",
)
def metrics_insights(target: Target) -> Seen:
    """An alarm may sum a metric over all of its dimensions by Metrics Insights. If the metric has no data,
    the query completes, and the alarm leaves its first state."""
    cloudwatch = target.cloud.client("cloudwatch")
    names = [f"{target.cloud.namespace}-{name}" for name in _INSIGHTS]

    def alarms() -> list[dict[str, Any]] | None:
        """The alarms, once CloudWatch has evaluated each."""
        found = list(cloudwatch.describe_alarms(AlarmNames=names)["MetricAlarms"])
        looked = all(alarm["StateValue"] != "INSUFFICIENT_DATA" for alarm in found)
        return found if looked and found else None

    found = until(alarms, "the alarms' first state", within_s=180)
    now = datetime.now(timezone.utc)
    queries = [
        {"Id": f"q{i}", "Expression": alarm["Metrics"][0]["Expression"], "Period": 60}
        for i, alarm in enumerate(found)
    ]
    answer = cloudwatch.get_metric_data(
        MetricDataQueries=queries, StartTime=now - timedelta(hours=1), EndTime=now
    )
    return {
        "alarms": len(found),
        "evaluation": sorted({alarm.get("EvaluationState", "as it should") for alarm in found}),
        "queries": sorted(result["StatusCode"] for result in answer["MetricDataResults"]),
        "messages": [message["Code"] for message in answer.get("Messages", [])],
        "note_states": {alarm["AlarmName"]: alarm["StateValue"] for alarm in found},
    }


@question(
    "alarms.alert",
    expected={
        "subject": "NAMESPACE: ROBOT, fault 5, MOSFET over-temperature",
        "first_line": "ROBOT: fault 5, MOSFET over-temperature",
        "says": ["when", "stream"],
    },
    relied_on_by=("functions/alert.py", "stacks/storage.py", "contract/iort_contract/catalog/rules.py"),
)
def alert(target: Target) -> Seen:
    """A car's fault goes from the rule fault to the alert function, which may note it in the car's row, and
    from there to the alarm topic's subscribers."""
    bundle, namespace = target.robot("verify-alert"), target.cloud.namespace
    topic = target.cloud.output("processing", "AlarmTopic")
    with inbox(target, topic) as receive, Robot(bundle.folder) as robot:
        robot.online()
        now_us = time.time_ns() // 1000
        live = encode_live(LiveSample(RUN, 0, now_us, now_us, {FAULT_FIELD: _FAULT}))
        # Not by Basic Ingest, which reaches only the live rule.
        robot.publish(build_topic(LIVE, robot.name, VESC_STREAM, namespace), live)
        mail = receive(lambda mail: robot.name in mail["Message"], "the alert at the topic's subscriber")
    lines = mail["Message"].replace(bundle.robot, "ROBOT").replace(namespace, "NAMESPACE").splitlines()
    return {
        "subject": mail["Subject"].replace(bundle.robot, "ROBOT").replace(namespace, "NAMESPACE"),
        "first_line": lines[0],
        "says": [line.split()[0] for line in lines if line.startswith(("when ", "stream "))],
    }


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
