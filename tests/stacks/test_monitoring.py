"""Every failure that must be noticed has an alarm, and every alarm is documented."""

from __future__ import annotations

import ast
import json
import re
from typing import NamedTuple

import pytest

from functions.shared.summary import measure
from iort_contract.catalog.metrics import METRIC_NAMESPACE, METRICS, metrics_of
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM
from iort_contract.limits import DEFAULT_NAMESPACE, LIVE_MIN_RATE_HZ
from iort_contract.messages.batch import Batch
from iort_station.cost.report import (
    FREE_DASHBOARD_METRICS,
    FREE_DASHBOARDS,
    ROBOT_SEARCHES,
    dashboard_metrics,
)
from iort_station.cost.usage import Usage
from iort_station.operations import cloudwatch
from stacks.settings import ROOT
from tests.stacks.templates import name

# The metrics of AWS that the stacks may name.

# Dimensions of each metric. AWS IoT Developer Guide, "AWS IoT metrics and dimensions"; Lambda Developer
# Guide, "Types of metrics for Lambda functions"; DynamoDB Developer Guide, "DynamoDB metrics and
# dimensions"; SQS Developer Guide, "Available CloudWatch metrics for Amazon SQS";
# Step Functions Developer Guide, "Execution metrics".
AWS_METRICS = {
    ("AWS/IoT", "Protocol"): {
        f"{what}.{how}"
        for what in ("Connect", "PublishIn", "PublishOut", "Subscribe")
        for how in ("Success", "AuthError", "Throttle")
    },
    ("AWS/IoT", "RuleName"): {"TopicMatch", "ParseError", "RuleMessageThrottled"},
    ("AWS/IoT", "ActionType", "RuleName"): {"Failure", "Success", "ErrorActionFailure"},
    ("AWS/Lambda", "FunctionName"): {
        "Duration",
        "ConcurrentExecutions",
        "Errors",
        "Throttles",
        "IteratorAge",
        "DestinationDeliveryFailures",
    },
    # "Across all functions".
    ("AWS/Lambda",): {"ConcurrentExecutions", "Errors", "Throttles"},
    ("AWS/DynamoDB", "TableName"): {
        "ConsumedReadCapacityUnits",
        "ConsumedWriteCapacityUnits",
        "ReadThrottleEvents",
        "WriteThrottleEvents",
    },
    ("AWS/SQS", "QueueName"): {"ApproximateNumberOfMessagesVisible"},
    ("AWS/States", "StateMachineArn"): {"ExecutionsFailed"},
}


def test_every_queue_function_and_table_has_an_alarm(synthesized, alarms):
    for kind, ending in (
        ("AWS::SQS::Queue", "Waiting"),
        ("AWS::Lambda::Function", "Errors"),
        ("AWS::DynamoDB::Table", "Throttled"),
    ):
        for logical_id in synthesized.resources(kind):
            assert f"{name(logical_id)}{ending}" in alarms


def test_the_cost_model_counts_every_alarm(synthesized, alarms):
    """Alarms by Metrics Insights count by the metrics that they read after every failure: one a rule, and for
    Lambda one a function, one a function with its qualifier, and one for all."""
    insights = [alarm["Metrics"][0]["Expression"] for alarm in alarms.values() if "Metrics" in alarm]
    assert Usage().alarms == len(alarms) - len(insights)
    of_lambda = 2 * len(synthesized.resources("AWS::Lambda::Function")) + 1
    most = [len(RULES) if "AWS/IoT" in query else of_lambda for query in insights]
    assert Usage().insights_metrics == sum(most)


def test_every_alarm_notifies_the_topic_and_is_documented(alarms, reader):
    text = (ROOT / "docs/how-to/alarms.md").read_text()
    for alarm, properties in alarms.items():
        assert reader.texts(properties["AlarmActions"]) == ["Alarms"]
        assert properties["TreatMissingData"] == "notBreaching"
        # It is shown in AWS' console and in its mail, where docs/ is not.
        description = properties["AlarmDescription"]
        assert re.fullmatch(r"\w.*\. What to do: .*", description)
        assert "](" not in description
        assert len(description) <= 1024
        generic = re.sub(r"^.*(Waiting|Errors|Throttled|Behind|Failed)$", r"\1", alarm)
        assert f"`{generic}`" in text or f"`...{generic}`" in text, (
            f"docs/how-to/alarms.md says nothing of {alarm}"
        )


def test_the_slowest_live_lane_can_set_off_its_alarms(alarms):
    """A lane with one message in 100 s does not have a message in each of three successive minutes."""
    every_s = 1 / LIVE_MIN_RATE_HZ
    for name_ in ("PubNubFailed", "CarToLambdaMs"):
        alarm = alarms[name_]
        periods, needed = alarm["EvaluationPeriods"], alarm["DatapointsToAlarm"]
        assert alarm["Period"] == 60
        for offset_s in range(60):
            minutes = {int(offset_s + i * every_s) // 60 for i in range(100)}
            assert all(len(minutes & set(range(i, i + periods))) >= needed for i in range(100))


# The dashboards show exactly the metrics of the functions and existing metrics of AWS.

FUNCTIONS = sorted((ROOT / "functions").rglob("*.py"))


@pytest.fixture(scope="module")
def shown(synthesized):
    """Every metric on the dashboards: namespace, name, dimensions, options."""
    metrics = []
    for body in dashboards(synthesized).values():
        for widget in body["widgets"]:
            rows = widget["properties"].get("metrics", [])
            metrics += [of_row(row) for row in rows]
    return metrics


def dashboards(app):
    """The bodies by name; values that are known only after deployment stay as references."""
    found = {}
    for dashboard in app.resources("AWS::CloudWatch::Dashboard").values():
        separator, parts = dashboard["DashboardBody"]["Fn::Join"]
        assert separator == ""
        text = "".join(
            part if isinstance(part, str) else f"<{json.dumps(part)}>".replace('"', "'") for part in parts
        )
        found[dashboard["DashboardName"]] = json.loads(text)
    return found


class Counted(NamedTuple):
    """What AWS bills of a dashboard: a metric each time it is shown, and searches, which find any number."""

    metrics: int
    searches: int


def counted(app):
    """The billed parts of the dashboards, by name."""
    found = {}
    for name_, body in dashboards(app).items():
        rows = [row for widget in body["widgets"] for row in widget.get("properties", {}).get("metrics", [])]
        shown = list(cloudwatch.metrics(rows))
        searches = sum("SEARCH(" in str(options.get("expression", "")) for _, options in shown)
        found[name_] = Counted(sum(len(parts) >= 2 for parts, _ in shown), searches)
    return found


def test_the_dashboards_are_free_and_the_cost_model_counts_their_metrics(synthesized):
    shown = counted(synthesized)
    assert list(shown) == ["iort-platform", "iort-services", "iort-robots"]
    # The rule live is one more than the default deployment has.
    assert tuple(one.metrics for one in shown.values()) == (
        Usage().dashboards[0] + 1,
        *Usage().dashboards[1:],
    )
    assert not any(one.searches for one in shown.values())
    assert all(one.metrics <= FREE_DASHBOARD_METRICS for one in shown.values())
    assert len(shown) <= FREE_DASHBOARDS


def test_the_last_dashboard_searches_the_metrics_of_every_robot(synthesized, production):
    searches = [one.searches for one in counted(production).values()]
    assert searches == [0, 0, ROBOT_SEARCHES]
    assert [one.metrics for one in counted(production).values()][1:] == list(Usage().dashboards)[1:]
    with_five = dashboard_metrics(Usage(robot_metrics=True, robots=5))
    assert with_five[-1] == Usage().dashboards[-1] + 5 * ROBOT_SEARCHES <= FREE_DASHBOARD_METRICS


def of_row(row):
    namespace, metric, *rest = row
    options = rest.pop() if isinstance(rest[-1], dict) else {}
    return namespace, metric, dict(zip(rest[::2], rest[1::2], strict=True)), options


def emitted():
    """Every metric that a function's code emits, by function."""
    found = {}
    for path in FUNCTIONS:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "emit":
                function = ast.literal_eval(node.args[0])
                named = {keyword.arg for keyword in node.keywords} - {"robot", None}
                found.setdefault(function, set()).update(named)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "self.counted.add":
                found.setdefault(path.stem, set()).update(keyword.arg for keyword in node.keywords)
    # These names are computed.
    batch = Batch("0" * 8, 0, [1], {"voltage_input": [12.0]})
    for stream in ("vesc", RTT_STREAM, AGENT_STREAM):
        found["health"] |= measure(stream, [batch]).keys()
    return found


def test_the_dashboards_show_exactly_the_functions_metrics(shown):
    by_function = {}
    for namespace, metric, dimensions, options in shown:
        if namespace == METRIC_NAMESPACE:
            assert dimensions.keys() == {"Deployment", "Function"}
            assert dimensions["Deployment"] == DEFAULT_NAMESPACE
            by_function.setdefault(dimensions["Function"], set()).add(metric)
            assert options["stat"] == METRICS[metric].statistic
    assert by_function == {metric.function: set(metrics_of(metric.function)) for metric in METRICS.values()}
    assert emitted() == by_function


def test_every_metric_of_aws_exists(shown, alarms):
    of_alarms = [
        (a["Namespace"], a["MetricName"], {d["Name"]: d["Value"] for d in a["Dimensions"]})
        for a in alarms.values()
        if "Metrics" not in a
    ]
    for namespace, metric, dimensions in [*(one[:3] for one in shown), *of_alarms]:
        if namespace != METRIC_NAMESPACE:
            assert metric in AWS_METRICS[(namespace, *sorted(dimensions))]
        elif METRICS[metric].function != dimensions["Function"]:
            raise AssertionError(f"nothing emits {metric}")
