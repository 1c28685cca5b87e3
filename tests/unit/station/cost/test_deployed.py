"""`iort cost --deployed` counts a deployment's alarms and dashboards."""

from __future__ import annotations

import json

from iort_station.cost.bill.fixed_costs import deployment_dollars_per_month
from iort_station.cost.deployed import watching
from iort_station.cost.usage import Usage

ROWS = [["AWS/IoT", "TopicMatch", "RuleName", "a"], ["...", "b"]]
SEARCH = [[{"expression": "SEARCH('{iort,Robot} MetricName=\"BatteryVolts\"', 'Sum', 60)"}]]


class CloudWatch:
    """A fake account with a metric alarm, a Metrics Insights alarm, and dashboards."""

    namespace = "iort"

    def __init__(self, dashboards):
        self.bodies = dashboards

    def client(self, service):
        assert service == "cloudwatch"
        return self

    def get_paginator(self, operation):
        self.operation = operation
        return self

    def paginate(self, **asked):
        query = {"Id": "m1", "Expression": 'SELECT SUM(ParseError) FROM "AWS/IoT"'}
        if self.operation == "describe_alarms":
            yield {"MetricAlarms": [{"AlarmName": "a", "MetricName": "Errors"}, {"Metrics": [query]}]}
        elif self.operation == "list_metrics":
            assert asked == {"Namespace": "AWS/IoT", "MetricName": "ParseError", "RecentlyActive": "PT3H"}
            yield {"Metrics": [{}, {}]}
            yield {"Metrics": [{}]}
        else:
            assert self.operation == "list_dashboards"
            yield {"DashboardEntries": [{"DashboardName": name} for name in self.bodies]}

    def get_dashboard(self, *, DashboardName):
        widgets = [
            {"type": "metric", "properties": {"metrics": self.bodies[DashboardName]}},
            {"type": "text"},
        ]
        return {"DashboardBody": json.dumps({"widgets": widgets})}


def test_alarms_and_dashboards_are_counted_as_aws_bills_them():
    found = watching(CloudWatch({"iort-robots": ROWS, "iort-platform": ROWS * 30, "other": ROWS[:1]}))
    assert found == {
        "alarms": 1,
        "insights_metrics": 3,
        "dashboards": (60, 1, 2),
        "robot_metrics": False,
    }
    rest = deployment_dollars_per_month(Usage(**found))
    assert rest["dashboards"] == 3.0, "the one of over fifty"


def test_a_search_on_the_robots_dashboard_means_metrics_of_every_robot():
    found = watching(CloudWatch({"iort-robots": ROWS + SEARCH, "zebra": ROWS}))
    assert (found["dashboards"], found["robot_metrics"]) == ((2, 2), True)
    assert not watching(CloudWatch({}))["robot_metrics"]
