"""Alarms, alerts and what they rest on: notices reach a person, and printed lines become metrics."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE
from iort_contract.catalog.vesc import FAULT_FIELD
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.messages.page import AlarmEntry
from iort_contract.topics import LIVE
from iort_station.errors import StationError
from iort_station.operations import alarms
from testkit.target import configure
from testkit.waiting import InstrumentError, until
from verify.lab import RUN, Lab, batch
from verify.question import CHANGED, Seen, pages, question

_REASON = "verify: does it notify?"
_ALARM = "ALARM"
# With every character that a tag's value may have, beside letters and digits.
_BY = "verify +-=._:/@"
# The alarms that use Metrics Insights: stacks/monitoring.py.
_INSIGHTS = ("ParseError", "ErrorActionFailure", "RuleMessageThrottled", "DestinationDeliveryFailures")


def _quiet(lab: Lab) -> dict[str, Any]:
    """An alarm of the deployment that is not in ALARM: only a change of state sends a notice."""
    pages = lab.client("cloudwatch").get_paginator("describe_alarms")
    for page in pages.paginate(AlarmNamePrefix=f"{lab.namespace}-", AlarmTypes=["MetricAlarm"]):
        for alarm in page["MetricAlarms"]:
            if alarm["StateValue"] != _ALARM:
                return dict(alarm)
    raise InstrumentError("every alarm of the deployment is in ALARM")


def _raise(lab: Lab, alarm: dict[str, Any]) -> None:
    """Set the alarm's state to ALARM, and back at the end."""
    state = {"StateValue": alarm["StateValue"], "StateReason": alarm.get("StateReason", "")}
    cloudwatch, name = lab.client("cloudwatch"), alarm["AlarmName"]
    lab.undo(cloudwatch.set_alarm_state, AlarmName=name, **state)
    cloudwatch.set_alarm_state(AlarmName=name, StateValue=_ALARM, StateReason=_REASON)


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
    aws="cloudwatch-api:API_SetAlarmState",
    expected=_NOTIFIED,
)
def set_state(lab: Lab) -> Seen:
    """An alarm whose state is set to ALARM notifies the alarm topic, and the topic its subscribers, with
    name, description, both states and the reason."""
    topic, alarm = lab.cloud.output("processing", "AlarmTopic"), _quiet(lab)
    receive = lab.inbox(topic)
    _raise(lab, alarm)
    mail = receive(
        lambda mail: mail.get("Subject", "").startswith(_ALARM) and _REASON in mail["Message"],
        "the alarm at the topic's subscriber",
    )
    notice = json.loads(mail["Message"])
    attributes = lab.client("sns").get_topic_attributes(TopicArn=topic)["Attributes"]
    return {
        "topic_has_key": bool(attributes.get("KmsMasterKeyId")),
        "type": mail["Type"],
        "subject_names_alarm": alarm["AlarmName"] in mail["Subject"],
        "alarm": notice["AlarmName"] == alarm["AlarmName"],
        "description": notice["AlarmDescription"] == alarm["AlarmDescription"],
        "new_state": notice["NewStateValue"],
        "old_state": notice["OldStateValue"] == alarm["StateValue"],
        "reason": notice["NewStateReason"],
    }


@question(
    "alarms.acknowledged",
    aws="cloudwatch-api:API_TagResource",
    expected={"by": _BY, "kept": True},
)
def acknowledged(lab: Lab) -> Seen:
    """A raised alarm takes a tag that says who has seen it and when, and keeps it."""
    alarm = _quiet(lab)

    def entry() -> AlarmEntry:
        return next(one for one in alarms.alarms(lab.cloud) if one["name"] == alarm["AlarmName"])

    def kept() -> Seen | None:
        """None if the alarm's own evaluation, which may come at any moment, has ended it."""
        _raise(lab, alarm)
        raised = entry()
        try:
            seen = alarms.acknowledge(lab.cloud, raised["key"], raised["since_s"], _BY)
        except StationError:
            return None
        after = entry()
        if (after["state"], after["since_s"]) != (_ALARM, raised["since_s"]):
            return None
        told = after["acknowledged"]
        same = told is not None and abs(told["at_s"] - seen["at_s"]) < 0.01
        return {"by": told["by"] if told else None, "kept": same}

    return until(kept, "an alarm that stays raised while it is acknowledged")


set_state_with_key = replace(
    set_state,
    name="alarms.set_state_with_key",
    assumed=(
        "The same with a topic encrypted with the account's own key, which admits CloudWatch "
        "without a condition."
    ),
    expected={**_NOTIFIED, "topic_has_key": True},
    source=pages("https://repost.aws/knowledge-center/cloudwatch-configure-alarm-sns"),
    phase=CHANGED,
    not_embedded="the embedded cloud is deployed without a key: its topics encrypt nothing",
)


@question(
    "alarms.metrics_insights",
    aws="cloudwatch:alarm-evaluation",
    expected={
        "alarms": len(_INSIGHTS),
        "evaluation": ["as it should"],
        "queries": ["Complete"] * len(_INSIGHTS),
        "messages": [],
    },
    not_embedded="the embedded cloud has no Metrics Insights, and is deployed without these alarms",
)
def metrics_insights(lab: Lab) -> Seen:
    """An alarm may sum a metric over all of its dimensions by Metrics Insights. If the metric has no data,
    the query completes, and the alarm leaves its first state."""
    cloudwatch, names = lab.client("cloudwatch"), [f"{lab.namespace}-{name}" for name in _INSIGHTS]

    def evaluated() -> list[dict[str, Any]] | None:
        alarms = list(cloudwatch.describe_alarms(AlarmNames=names)["MetricAlarms"])
        return alarms if all(alarm["StateValue"] != "INSUFFICIENT_DATA" for alarm in alarms) else None

    alarms, now = until(evaluated, "the alarms' first state", within_s=180), datetime.now(timezone.utc)
    queries = [
        {"Id": f"q{i}", "Expression": alarm["Metrics"][0]["Expression"], "Period": 60}
        for i, alarm in enumerate(alarms)
    ]
    hour = {"StartTime": now - timedelta(hours=1), "EndTime": now}
    answer = cloudwatch.get_metric_data(MetricDataQueries=queries, **hour)
    return {
        "alarms": len(alarms),
        "evaluation": sorted({alarm.get("EvaluationState", "as it should") for alarm in alarms}),
        "queries": sorted(result["StatusCode"] for result in answer["MetricDataResults"]),
        "messages": [message["Code"] for message in answer.get("Messages", [])],
        "note_states": {alarm["AlarmName"]: alarm["StateValue"] for alarm in alarms},
    }


@question(
    "alarms.alert",
    expected={
        "subject": "NAMESPACE: ROBOT, fault 5, MOSFET over-temperature",
        "first_line": "ROBOT: fault 5, MOSFET over-temperature",
        "says": ["when", "stream"],
    },
)
def alert(lab: Lab) -> Seen:
    """A car's fault goes from the rule fault to the alert function, which may note it in the car's row, and
    from there to the alarm topic's subscribers."""
    receive = lab.inbox(lab.cloud.output("processing", "AlarmTopic"))
    robot, now_us = lab.connected(lab.robot("verify-alert").folder), time.time_ns() // 1000
    # Not by Basic Ingest, which reaches only the live rule.
    sample = LiveSample(RUN, 0, now_us, now_us, {FAULT_FIELD: 5})
    robot.publish(lab.topic(LIVE, robot.name), encode_live(sample))
    mail = receive(lambda mail: robot.name in mail["Message"], "the alert at the topic's subscriber")
    subject, text = (
        mail[name].replace(robot.name, "ROBOT").replace(lab.namespace, "NAMESPACE")
        for name in ("Subject", "Message")
    )
    lines = text.splitlines()
    says = [line.split()[0] for line in lines if line.startswith(("when ", "stream "))]
    return {"subject": subject, "first_line": lines[0], "says": says}


_METRIC, _FUNCTION = "BatchesSummarized", "summarize"


def _count(lab: Lab, since: datetime) -> float:
    """The number of batches that Lambda 2 has summarised since then, by its metric."""
    dimensions = {METRIC_DEPLOYMENT: lab.namespace, METRIC_FUNCTION: _FUNCTION}
    metric = {
        "Namespace": METRIC_NAMESPACE,
        "MetricName": _METRIC,
        "Dimensions": [{"Name": name, "Value": value} for name, value in dimensions.items()],
    }
    answer = lab.client("cloudwatch").get_metric_data(
        MetricDataQueries=[{"Id": "q", "MetricStat": {"Metric": metric, "Period": 60, "Stat": "Sum"}}],
        StartTime=since,
        EndTime=datetime.now(timezone.utc) + timedelta(minutes=2),
    )
    return float(sum(value for result in answer["MetricDataResults"] for value in result["Values"]))


@question(
    "logs.metric",
    aws="""cloudwatch:CloudWatch_Embedded_Metric_Format_Specification
    lambda:monitoring-cloudwatchlogs-log-level""",
    expected={"counted": True},
)
def metric(lab: Lab) -> Seen:
    """If a function prints a line in the embedded metric format, with logs in JSON and the level INFO, it
    becomes a metric with our dimensions within three minutes."""
    function = lab.configuration(lab.cloud.output("processing", "SummarizeFunction"))
    logging = function.get("LoggingConfig", {})
    since = datetime.now(timezone.utc).replace(second=0, microsecond=0) - timedelta(minutes=15)
    before, bundle = _count(lab, since), lab.robot("verify-metric")
    lab.send(bundle, batch())
    began = time.monotonic()
    try:
        counted = until(lambda: _count(lab, since) > before, _METRIC, within_s=170)
    except InstrumentError:
        counted = False
    return {
        "counted": counted,
        "note_logging": {name: logging[name] for name in sorted(logging) if name != "LogGroup"},
        "note_after_s": round(time.monotonic() - began),
    }


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


@question(
    "logs.lines",
    expected={"printed_as_it_is": True, "warning_is_shown": True, "failure_is_shown": True},
)
def lines(lab: Lab) -> Seen:
    """With logs in JSON, printed lines stay unchanged; warnings and uncaught errors are lines with their
    level, which the dashboard's log widget finds."""
    logging = lab.configuration(lab.cloud.output("processing", "EchoFunction"))["LoggingConfig"]
    client, began_ms = lab.client("lambda"), int(time.time() * 1000)
    name = lab.function("speaking", _SPEAKING, memory_mb=128)
    configure(client, name, LoggingConfig=logging)
    client.invoke(FunctionName=name, Payload=b"{}")

    def said() -> list[str]:
        """The lines of the function's environment, once the last one is there."""
        events = lab.events(logging["LogGroup"], began_ms)
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
