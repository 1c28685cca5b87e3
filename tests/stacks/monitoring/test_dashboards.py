"""The dashboards show exactly the metrics of the functions and existing metrics of AWS."""

from __future__ import annotations

import ast
import json
import re

import pytest

from functions.shared.summary import measure
from iort_contract.catalog.metrics import METRIC_NAMESPACE, METRICS, metrics_of
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.batch import Batch
from iort_station.cost.model import (
    FREE_DASHBOARD_METRICS,
    FREE_DASHBOARDS,
    ROBOT_SEARCHES,
    dashboard_metrics,
)
from iort_station.cost.usage import Usage
from iort_station.operations import cloudwatch
from stacks.settings import ROOT
from tests.stacks.monitoring.aws_metrics import AWS_METRICS

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


def test_the_platform_shows_the_state_of_every_alarm(synthesized):
    first = dashboards(synthesized)["iort-platform"]["widgets"][0]
    assert first["type"] == "alarm"
    told = " ".join(first["properties"]["alarms"])
    alarms = synthesized.resources("AWS::CloudWatch::Alarm")
    assert len(alarms) == len(first["properties"]["alarms"])
    assert all(f"'{logical_id}'" in told for logical_id in alarms)


def test_the_platform_reads_every_functions_log(synthesized):
    widgets = dashboards(synthesized)["iort-platform"]["widgets"]
    (log,) = [widget for widget in widgets if widget["type"] == "log"]
    # The log groups' names are references until deployment.
    read = re.findall(r"SOURCE '<(.+?)>'", log["properties"]["query"])
    groups = [
        name for name in synthesized.resources("AWS::Logs::LogGroup") if not name.startswith("MachineLog")
    ]
    assert len(read) == len(set(read)) == len(groups) > 0


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


def counted(app):
    """The billed parts of the dashboards, by name."""
    return {name: cloudwatch.count(body["widgets"]) for name, body in dashboards(app).items()}


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


def test_the_dashboards_cover_every_service(shown):
    assert {namespace for namespace, *_ in shown} == {
        "AWS/IoT",
        "AWS/DynamoDB",
        "AWS/Lambda",
        "AWS/SQS",
        METRIC_NAMESPACE,
    }
    rules = {dimensions["RuleName"] for _, _, dimensions, _ in shown if "RuleName" in dimensions}
    assert rules == {rule.physical_name() for rule in RULES.values()}


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
