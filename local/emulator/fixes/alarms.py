"""Fixes of CloudWatch's alarms, with the points of the metrics that they look at."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ministack.core.responses import set_request_region
from ministack.services import cloudwatch

LOCK = threading.Lock()
_MINUTE_S = 60
_KEPT_S = 3 * 3600
# Different values of a minute that are kept for percentiles; more values only raise their counts.
_VALUES = 120


def record(namespace: str, name: str, value: float, unit: str, **dimensions: str) -> None:
    """Add a value to the current minute."""
    minute = int(time.time()) // _MINUTE_S * _MINUTE_S
    with LOCK:
        bucket = cloudwatch._metric_bucket((namespace, name, cloudwatch._dims_key(dimensions)))
        running = [point for point in bucket[-_VALUES:] if point["Timestamp"] == minute]
        same = next((point for point in running if point["Value"] == value), None)
        if same is None and len(running) == _VALUES:
            same = running[int(sum(point["Count"] for point in running)) % _VALUES]
        if same is not None:
            same["Count"] += 1.0
            return
        bucket.append(
            {
                "Timestamp": minute,
                "Value": float(value),
                "Count": 1.0,
                "Unit": unit,
                "Dimensions": dict(dimensions),
            }
        )


def forget_old() -> None:
    """Delete the points of more than three hours ago."""
    oldest_s = time.time() - _KEPT_S
    with LOCK:
        for key, points in list(cloudwatch._metrics.items()):
            cloudwatch._metrics[key] = [point for point in points if point["Timestamp"] >= oldest_s]


_BELOW = {"LessThanThreshold": False, "LessThanOrEqualToThreshold": True}


def close_alarm_state() -> None:
    """The state of an alarm.

    AWS: evaluates the metric with the alarm's own dimensions. All the evaluation periods must breach, and a
      period without data does not, as our alarms are set
      (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/AlarmThatSendsEmail.html).
    ministack: takes the points of every dimension together, over all periods at once, and keeps the last
      state when no data comes.
    Test: tests/local/operations/test_metrics.py::test_an_alarm_needs_all_periods_and_its_own_dimensions
    Patch: none; a patch would have to know every value of TreatMissingData, where ours know one
    """
    cloudwatch._evaluate_alarm = partial(evaluate, since_s=time.time())


def evaluate(alarm: dict[str, Any], *, since_s: float = 0.0) -> None:
    """Set the state of an alarm by the periods up to now, and run its actions if it has changed.

    Points from before ``since_s`` are lost: an alarm that was raised before stays for as long as they could
    have kept it.
    """
    before, now_s = alarm["StateValue"], time.time()
    after = "ALARM" if breaching(alarm, now_s) else "OK"
    if before == after:
        return
    period, count = _periods(alarm)
    if before == "ALARM" and alarm["StateUpdatedTimestamp"] < since_s and now_s < since_s + period * count:
        return
    reason = f"{alarm['MetricName']} {alarm['ComparisonOperator']} {alarm['Threshold']}: {after}"
    alarm |= {"StateValue": after, "StateReason": reason, "StateUpdatedTimestamp": int(time.time())}
    cloudwatch._record_history(alarm["AlarmName"], before, after, reason)
    cloudwatch._dispatch_alarm_actions(alarm, before, after, reason)


def breaching(alarm: Mapping[str, Any], now_s: float) -> bool:
    """Whether all of the last periods are beyond the threshold, with or without the current one."""
    period, count = _periods(alarm)
    dimensions = {d["Name"]: d["Value"] for d in alarm.get("Dimensions") or []}
    key = (alarm.get("Namespace"), alarm.get("MetricName"), cloudwatch._dims_key(dimensions))
    buckets: dict[int, list[Any]] = defaultdict(list)
    with LOCK:
        for point in cloudwatch._metrics.get(key) or []:
            buckets[int(point["Timestamp"] // period)].append(point)
    statistic = alarm.get("ExtendedStatistic") or alarm.get("Statistic") or "Average"

    def over(index: int) -> bool:
        points = buckets.get(index)
        if not points:
            return False
        value = cloudwatch._stat_value(cloudwatch._calc_stats(points), statistic, points)
        limit, operator = float(alarm["Threshold"]), alarm["ComparisonOperator"]
        if operator in _BELOW:
            return bool(value < limit or (_BELOW[operator] and value == limit))
        return bool(value > limit or (operator == "GreaterThanOrEqualToThreshold" and value == limit))

    now = int(now_s // period)
    return any(all(over(last - i) for i in range(count)) for last in (now, now - 1))


def _periods(alarm: Mapping[str, Any]) -> tuple[int, int]:
    """The seconds of a period, and how many are evaluated."""
    return int(alarm.get("Period") or 60), int(alarm.get("EvaluationPeriods") or 1)


_TICK_S = 5.0
# What has to be recorded before the alarms are evaluated.
BEFORE_ALARMS: list[Callable[[], None]] = []


def close_alarm_timer() -> None:
    """Alarms look by themselves.

    AWS: evaluates an alarm once a period, whether data comes or not
      (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/AlarmThatSendsEmail.html).
    ministack: evaluates alarms only when somebody puts data, changes or describes one.
    Test: tests/local/operations/test_eyes.py::test_a_fault_reaches_a_human_and_the_dashboards
    Patch: none; ministack has no clock of its own
    """
    # `start` closes the gap once the emulator is configured.


def start(region: str) -> None:
    """Evaluate the alarms of a region every few seconds, as long as the process lives."""
    threading.Thread(target=_tick, args=(region,), daemon=True, name="cloudwatch").start()


def _tick(region: str) -> None:
    set_request_region(region)
    while True:
        time.sleep(_TICK_S)
        for each in BEFORE_ALARMS:
            each()
        cloudwatch._evaluate_all_alarms()
        forget_old()
