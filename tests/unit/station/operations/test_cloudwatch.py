"""CloudWatch's dashboards as the page draws them."""

from __future__ import annotations

import json
import time
from datetime import datetime, timezone

import boto3
import pytest

from iort_station.errors import StationError
from iort_station.operations import cloudwatch

NOW_S = 1_700_000_000


class FakeCloud:
    """A `iort_station.cloud.Cloud` with only CloudWatch."""

    namespace = "iort"

    def client(self, service):
        assert service == "cloudwatch"
        return boto3.client(service)


@pytest.fixture
def cloud(aws):
    return FakeCloud()


def put(cloud, name, *widgets):
    cloud.client("cloudwatch").put_dashboard(
        DashboardName=name, DashboardBody=json.dumps({"widgets": list(widgets)})
    )


def metric(*rows, **properties):
    return {
        "type": "metric",
        "x": 8,
        "y": 1,
        "properties": {"metrics": list(rows), "title": "T", **properties},
    }


def test_our_dashboards_come_first(cloud):
    for name in ("another", "iort-monitoring", "Zebra"):
        put(cloud, name)
    assert cloudwatch.dashboards(cloud) == ["iort-monitoring", "Zebra", "another"]


def test_a_widget_has_its_position_and_its_metrics_values(cloud):
    rows = [
        ["My/Cars", "Laps", "Car", "a", {"stat": "Sum", "period": 60, "label": "laps"}],
        [".", "Speed", ".", "a", {"stat": "Maximum", "period": 60, "yAxis": "right"}],
    ]
    put(cloud, "d", metric(*rows, view="timeSeries"), {"type": "text", "properties": {"markdown": "# Hello"}})
    client = cloud.client("cloudwatch")
    for name, value in (("Laps", 2), ("Laps", 3), ("Speed", 4.5)):
        datum = {"MetricName": name, "Dimensions": [{"Name": "Car", "Value": "a"}], "Value": value}
        stamp = datetime.fromtimestamp(NOW_S - 120, timezone.utc)
        client.put_metric_data(Namespace="My/Cars", MetricData=[{**datum, "Timestamp": stamp}])
    found = cloudwatch.dashboard(cloud, "d", minutes=30, now_s=NOW_S)
    drawn, words = found["widgets"]
    assert found["to_s"] - found["from_s"] == 30 * 60
    assert (drawn["x"], drawn["y"], drawn["width"], drawn["height"]) == (8, 1, 6, 6)
    assert (drawn["kind"], drawn["title"], drawn["period_s"]) == ("series", "T", 60)
    laps, speed = drawn["series"]
    assert (laps["label"], laps["right"], laps["values"]) == ("laps", False, [5])
    assert (speed["label"], speed["right"], speed["values"]) == ("Speed", True, [4.5])
    assert found["from_s"] <= laps["times_s"][0] <= found["to_s"]
    assert (words["kind"], words["text"]) == ("text", "# Hello")


def test_shorthand_in_a_row_repeats_the_row_before():
    rows = [
        ["AWS/IoT", "Success", "RuleName", "a", "ActionType", "Lambda", {"label": "x"}],
        [".", "Failure", ".", "b", ".", "."],
        ["...", "Republish"],
        [{"expression": "m1 + m2", "id": "e1"}],
    ]
    assert [parts for parts, _ in cloudwatch.metrics(rows)] == [
        ["AWS/IoT", "Success", "RuleName", "a", "ActionType", "Lambda"],
        ["AWS/IoT", "Failure", "RuleName", "b", "ActionType", "Lambda"],
        ["AWS/IoT", "Failure", "RuleName", "b", "ActionType", "Republish"],
        [],
    ]


def test_widgets_that_are_not_drawn_are_named(cloud):
    put(cloud, "d", {"type": "log", "properties": {"query": "x"}}, {"type": "explorer", "properties": {}})
    found = cloudwatch.dashboard(cloud, "d", minutes=5, now_s=NOW_S)
    # A log widget's rows are requested by its number.
    assert [(each["number"], each["kind"], each["text"].split(":")[0]) for each in found["widgets"]] == [
        (0, "log", ""),
        (1, "other", "a widget of type explorer"),
    ]


def test_alarms_are_shown_in_the_widgets_order_with_state_and_reason(cloud):
    client = cloud.client("cloudwatch")
    for name in ("first", "second"):
        client.put_metric_alarm(
            AlarmName=name,
            AlarmDescription=f"the {name}",
            Namespace="My/Cars",
            MetricName="Laps",
            Statistic="Sum",
            Period=60,
            EvaluationPeriods=1,
            Threshold=1,
            ComparisonOperator="GreaterThanThreshold",
        )
    client.set_alarm_state(AlarmName="first", StateValue="ALARM", StateReason="too many laps")
    client.set_alarm_state(AlarmName="second", StateValue="OK", StateReason="few laps")
    arns = {alarm["AlarmName"]: alarm["AlarmArn"] for alarm in client.describe_alarms()["MetricAlarms"]}
    gone = arns["first"].replace("first", "gone")
    put(cloud, "d", {"type": "alarm", "properties": {"alarms": [arns["second"], gone, arns["first"]]}})
    (drawn,) = cloudwatch.dashboard(cloud, "d", minutes=5)["widgets"]
    assert drawn["kind"] == "alarms"
    assert [(one["name"], one["state"], one["about"]) for one in drawn["alarms"]] == [
        ("second", "OK", "the second"),
        ("first", "ALARM", "the first"),
    ]
    assert drawn["alarms"][1]["reason"] == "too many laps"
    assert abs(drawn["alarms"][1]["since_s"] - time.time()) < 3600


def test_an_unknown_dashboard_is_an_error(cloud):
    with pytest.raises(StationError, match="dashboard 'nobody' does not exist"):
        cloudwatch.dashboard(cloud, "nobody", minutes=5, now_s=NOW_S)


class Searched:
    """A fake CloudWatch with one dashboard, its one search widget, and the search's results."""

    namespace = "iort"

    def __init__(self, *labels):
        stamp = datetime.fromtimestamp(NOW_S, timezone.utc)
        self.results = [
            {"Id": "iort0", "Label": label, "Timestamps": [stamp], "Values": [float(i)]}
            for i, label in enumerate(labels)
        ]

    def client(self, _service):
        return self

    def get_dashboard(self, **_name):
        expression = "SEARCH('{iort,Robot} MetricName=\"Samples\"', 'Sum', 60)"
        row = [{"expression": expression, "label": "samples"}]
        return {"DashboardBody": json.dumps({"widgets": [metric(row)]})}

    def get_paginator(self, _name):
        return self

    def paginate(self, **_asked):
        return [{"MetricDataResults": self.results}]


def test_a_search_is_a_line_for_each_metric_found():
    (widget,) = cloudwatch.dashboard(Searched("car1", "car2"), "d", minutes=5, now_s=NOW_S)["widgets"]
    assert [(one["label"], one["values"]) for one in widget["series"]] == [("car1", [0]), ("car2", [1])]
    (widget,) = cloudwatch.dashboard(Searched("cars", "cars"), "d", minutes=5, now_s=NOW_S)["widgets"]
    assert [(one["label"], one["values"]) for one in widget["series"]] == [("cars", [0]), ("cars", [1])]
    (widget,) = cloudwatch.dashboard(Searched(), "d", minutes=5, now_s=NOW_S)["widgets"]
    assert [(one["label"], one["values"]) for one in widget["series"]] == [("samples", [])]
