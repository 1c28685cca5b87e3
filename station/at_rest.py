"""What a deployment costs a month whoever drives. Pure.

Left out is what stays below a cent: Parameter Store's standard tier, SNS' mails, the budget and reading a
table's stream are free, and the code's and the page's files are some megabytes.
"""

from __future__ import annotations

from contract import METRICS
from station.prices import MONTH_HOURS, PRICES
from station.usage import Usage

# Lambda asks a queue with five long polls of at most 20 s around the clock. Without a bound on the
# concurrency it goes down to two; our mappings have one ("Configuring scaling behavior for SQS event source
# mappings"): the quarantine's, and that of the batches which were put off.
_QUEUES, _POLLERS, _POLL_S = 2, 5, 20
# SQS asks for the queue's key anew after five minutes (KmsDataKeyReusePeriodSeconds).
_KEYS_AN_HOUR = 12
_FREE_DASHBOARDS = 3


def deployment_dollars_per_month(usage: Usage) -> dict[str, float]:
    """Dollars by what they are for: metrics that functions emit, alarms, dashboards above three, the polls
    of the queues, and where the settings have them Device Defender's audit and the account's
    own key."""
    hours = MONTH_HOURS
    counts = {
        "metrics": ("metric", sum(map(len, METRICS.values()))),
        "alarms": ("alarm", usage.alarms),
        "dashboards": ("dashboard", max(0, usage.dashboards - _FREE_DASHBOARDS)),
        "polling the queues": ("queue_request", _QUEUES * _POLLERS * hours * 3600 / _POLL_S),
    }
    if usage.device_defender:
        counts["audit of the robots"] = ("audit", usage.robots)
    if usage.customer_key:
        counts["key"] = ("key", 1)
        counts["requests to the key, of the queue alone"] = ("key_request", _KEYS_AN_HOUR * hours)
    return {what: count * PRICES[price].each for what, (price, count) in counts.items()}
