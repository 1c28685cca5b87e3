"""What a deployment costs a month whoever drives. Pure.

CloudWatch's monthly allowances (`FREE_METRICS`, `FREE_ALARMS`, `FREE_DASHBOARDS`) are taken off: they are for
good, and of the whole account, so who uses them elsewhere pays for them here.

Left out is what stays below a cent: Parameter Store's standard tier, SNS' mails, the budget and reading a
table's stream are free, and the code's and the page's files are some megabytes.
"""

from __future__ import annotations

from collections.abc import Mapping

from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_station.cost.prices import MONTH_HOURS, PRICES, Price
from iort_station.cost.usage import Usage

# Lambda asks a queue with five long polls of at most 20 s around the clock. Without a bound on the
# concurrency it goes down to two; our mappings have one ("Configuring scaling behavior for SQS event source
# mappings"): the quarantine's, and that of the batches which were put off.
_QUEUES, _POLLERS, _POLL_S = 2, 5, 20
# SQS asks for the queue's key anew after five minutes (KmsDataKeyReusePeriodSeconds).
_KEYS_AN_HOUR = 12
# "Amazon CloudWatch pricing", free tier: three dashboards of up to fifty metrics each, ten custom metrics,
# ten alarms that name their metric. A dashboard of more metrics is billed, and so is each metric that a
# Metrics Insights alarm analyses or that GetMetricData is asked for.
FREE_DASHBOARDS, FREE_DASHBOARD_METRICS, FREE_METRICS, FREE_ALARMS = 3, 50, 10, 10
# The live page asks anew so often; CloudWatch's own console asks for nothing.
PAGE_REFRESH_S = 30
# With robot_metrics the last dashboard finds so many metrics of each robot, of what `health` counts of it.
ROBOT_SEARCHES = 4


def deployment_dollars_per_month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> dict[str, float]:
    """Dollars by what they are for: metrics that functions emit, alarms, dashboards and asking for their
    metrics, the polls of the queues, and where the settings have them Device Defender's audit and
    the account's own key."""
    hours, robots = MONTH_HOURS, usage.robots if usage.robot_metrics else 0
    metrics = len(METRICS) + robots * len(metrics_of("health"))
    dashboards = dashboard_metrics(usage)
    counts = {
        "metrics": ("metric", max(0, metrics - FREE_METRICS)),
        "alarms": ("alarm", max(0, usage.alarms - FREE_ALARMS)),
        "alarms by Metrics Insights, at most": ("insights_alarm", usage.insights_metrics),
        "dashboards": ("dashboard", _billed(dashboards)),
        # One is looked at, at a time; the largest is counted.
        "metrics asked for by the live page": (
            "metric_request",
            usage.dashboard_hours * 3600 / PAGE_REFRESH_S * max(dashboards, default=0),
        ),
        "polling the queues": ("queue_request", _QUEUES * _POLLERS * hours * 3600 / _POLL_S),
    }
    if usage.device_defender:
        counts["audit of the robots"] = ("audit", usage.robots)
    if usage.customer_key:
        counts["key"] = ("key", 1)
        counts["requests to the key, of the queue alone"] = ("key_request", _KEYS_AN_HOUR * hours)
    return {what: count * prices[price].each for what, (price, count) in counts.items()}


def dashboard_metrics(usage: Usage) -> tuple[int, ...]:
    """The metrics on each dashboard, those included that a search finds."""
    if not usage.robot_metrics or not usage.dashboards:
        return usage.dashboards
    return (*usage.dashboards[:-1], usage.dashboards[-1] + ROBOT_SEARCHES * usage.robots)


def _billed(dashboards: tuple[int, ...]) -> int:
    small = sum(metrics <= FREE_DASHBOARD_METRICS for metrics in dashboards)
    return len(dashboards) - min(small, FREE_DASHBOARDS)
