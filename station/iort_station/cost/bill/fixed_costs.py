"""The monthly costs of a deployment that do not depend on driving. Pure.

CloudWatch's permanent free tier (`FREE_METRICS`, `FREE_ALARMS`, `FREE_DASHBOARDS`) is subtracted. It is the
whole account's, so other uses of it cost extra here.

Costs below a cent are left out. Parameter Store's standard tier, SNS' mails, the budget and reading a table's
stream are free; the files of code and page are a few megabytes.
"""

from __future__ import annotations

from collections.abc import Mapping

from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_contract.cloud import IOT
from iort_station.cost.prices import MONTH_HOURS, PRICES, Price
from iort_station.cost.usage import Usage

# Lambda polls a queue around the clock with five long polls of at most 20 s. It needs only two for a mapping
# without a limit on its concurrency, but all of ours have one: the quarantine's, that of batches put off, and
# the archive's ("Configuring scaling behavior for SQS event source mappings").
_QUEUES, _POLLERS, _POLL_S = 3, 5, 20
# SQS requests the queue's key every five minutes (KmsDataKeyReusePeriodSeconds).
_KEYS_AN_HOUR = 12
# "Amazon CloudWatch pricing", free tier: three dashboards of up to fifty metrics each, ten custom metrics,
# ten alarms that name their metric. A dashboard with more metrics is billed, and so is each metric that a
# Metrics Insights alarm analyses or that GetMetricData returns.
FREE_DASHBOARDS, FREE_DASHBOARD_METRICS, FREE_METRICS, FREE_ALARMS = 3, 50, 10, 10
# The live page's refresh interval; CloudWatch's own console is free.
PAGE_REFRESH_S = 30
# With robot_metrics, the searches of the last dashboard find this many metrics per robot.
ROBOT_SEARCHES = 4


def deployment_dollars_per_month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> dict[str, float]:
    """Dollars by purpose: metrics, alarms, dashboards, queue polls, and if set Device Defender's audit and
    the account's own key."""
    hours, robots = MONTH_HOURS, usage.robots if usage.robot_metrics else 0
    metrics = len(METRICS) + robots * len(metrics_of("health"))
    if usage.live_transport == IOT:
        # AWS bills what is written, and nothing calls Lambda 1.
        metrics -= len(metrics_of("live"))
    dashboards = dashboard_metrics(usage)
    counts = {
        "metrics": ("metric", max(0, metrics - FREE_METRICS)),
        "alarms": ("alarm", max(0, usage.alarms - FREE_ALARMS)),
        "alarms by Metrics Insights, at most": ("insights_alarm", usage.insights_metrics),
        "dashboards": ("dashboard", _billed(dashboards)),
        # People look at one dashboard at a time; this counts the largest.
        "metrics requested by the live page": (
            "metric_request",
            usage.dashboard_hours * 3600 / PAGE_REFRESH_S * max(dashboards, default=0),
        ),
        "polling the queues": ("queue_request", _QUEUES * _POLLERS * hours * 3600 / _POLL_S),
    }
    if usage.device_defender:
        counts["audit of the robots"] = ("audit", usage.robots)
    if usage.customer_key:
        counts["key"] = ("key", 1)
        counts["requests to the key, by the queue"] = ("key_request", _KEYS_AN_HOUR * hours)
    return {what: count * prices[price].each for what, (price, count) in counts.items()}


def dashboard_metrics(usage: Usage) -> tuple[int, ...]:
    """The number of metrics on each dashboard, including those that a search finds."""
    if not usage.robot_metrics or not usage.dashboards:
        return usage.dashboards
    return (*usage.dashboards[:-1], usage.dashboards[-1] + ROBOT_SEARCHES * usage.robots)


def _billed(dashboards: tuple[int, ...]) -> int:
    small = sum(metrics <= FREE_DASHBOARD_METRICS for metrics in dashboards)
    return len(dashboards) - min(small, FREE_DASHBOARDS)
