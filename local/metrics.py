"""What the embedded cloud lacks of CloudWatch: metrics out of logs and of the services, and alarms that look.

ministack keeps and serves metrics, but nothing feeds them except synchronous invocations, and its alarms look
only when somebody puts data. Each wrapper here is around one of its functions, as in local/gaps.py:

- an EMF line in a function's log becomes metrics;
- AWS/Lambda counts every invocation, of each function and of all, AWS/IoT connections, messages, rules and
  their actions, AWS/SQS what waits in queues. AWS/DynamoDB's units are not counted: the emulator has no
  notion of them;
- GetMetricData answers `SEARCH(...)`;
- an alarm looks at its own dimensions, every few seconds, and takes missing data for no alarm.
"""

from __future__ import annotations

import json
import re
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from typing import Any

from ministack.core.responses import set_request_region
from ministack.services import cloudwatch, iot, lambda_svc, sqs

_TICK_S = 5.0
_MINUTE_S = 60
_KEPT_S = 3 * 3600
# So many values of a minute are kept for percentiles; more of them weigh on those.
_VALUES = 120
_SEARCH = re.compile(
    r"SEARCH\('\{(?P<schema>[^}]+)\} (?P<wanted>[^']+)', '(?P<stat>[^']+)', (?P<period>\d+)\)"
)
_BELOW = {"LessThanThreshold": False, "LessThanOrEqualToThreshold": True}
_lock = threading.Lock()
_running: dict[str, int] = defaultdict(int)


def install() -> None:
    """Close the gaps in this process, before the emulator starts."""
    lambda_svc._execute_function_dispatch = _counting_invocations(lambda_svc._execute_function_dispatch)
    # It counted synchronous invocations only; they are counted above.
    lambda_svc._emit_lambda_metrics = _throttles
    iot._run_rule_actions = _counting_matches(iot._run_rule_actions)
    iot._dispatch_rule_action = _counting_actions(iot._dispatch_rule_action)
    iot.broker_publish = _counting_messages(iot.broker_publish)
    cloudwatch._get_metric_data = _searching(cloudwatch._get_metric_data)
    cloudwatch._evaluate_alarm = evaluate


def start(region: str) -> None:
    """Look at queues and alarms from now on, as long as the process lives."""
    threading.Thread(target=_tick, args=(region,), daemon=True, name="cloudwatch").start()


# --- feeding ---------------------------------------------------------------------------------------


def record(namespace: str, name: str, value: float, unit: str, **dimensions: str) -> None:
    """Add a value to the minute that is running."""
    minute = int(time.time()) // _MINUTE_S * _MINUTE_S
    with _lock:
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


def record_log(text: str) -> None:
    """The metrics in the lines of a function's log that are in the embedded metric format.

    Source: CloudWatch, "Specification: Embedded metric format".
    """
    for line in text.splitlines():
        if '"_aws"' not in line:
            continue
        try:
            document = json.loads(line[line.index("{") :])
            directives = document["_aws"]["CloudWatchMetrics"]
        except (ValueError, KeyError, TypeError):
            continue
        for directive in directives:
            for names in directive["Dimensions"]:
                dimensions = {name: str(document[name]) for name in names}
                for metric in directive["Metrics"]:
                    values = document[metric["Name"]]
                    for value in values if isinstance(values, list) else [values]:
                        record(
                            directive["Namespace"],
                            metric["Name"],
                            value,
                            metric.get("Unit", "None"),
                            **dimensions,
                        )


def _counting_invocations(dispatch: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(dispatch)
    def execute(function: Any, config: dict[str, Any], event: Any, request_id: str, started: float) -> Any:
        name = config.get("FunctionName", "unknown")
        _running[name] += 1
        record("AWS/Lambda", "ConcurrentExecutions", _running[name], "Count", FunctionName=name)
        record("AWS/Lambda", "ConcurrentExecutions", sum(list(_running.values())), "Count")
        if (age_ms := _age_ms(event)) is not None:
            record("AWS/Lambda", "IteratorAge", age_ms, "Milliseconds", FunctionName=name)
        try:
            result = dispatch(function, config, event, request_id, started)
        finally:
            _running[name] -= 1
        took_ms = (time.time() - started) * 1000
        record("AWS/Lambda", "Invocations", 1, "Count", FunctionName=name)
        failed = 1 if result.get("error") else 0
        record("AWS/Lambda", "Errors", failed, "Count", FunctionName=name)
        record("AWS/Lambda", "Errors", failed, "Count")
        record("AWS/Lambda", "Duration", took_ms, "Milliseconds", FunctionName=name)
        record_log(result.get("log") or "")
        return result

    return execute


def _age_ms(event: Any) -> float | None:
    """How old the last record of a stream's batch is."""
    records = event.get("Records") if isinstance(event, dict) else None
    if not records or "dynamodb" not in records[-1]:
        return None
    created_s = float(records[-1]["dynamodb"].get("ApproximateCreationDateTime", 0))
    return max(0.0, (time.time() - created_s) * 1000) if created_s else None


def _throttles(function_name: str, **counts: Any) -> None:
    if counts.get("throttle"):
        record("AWS/Lambda", "Throttles", 1, "Count", FunctionName=function_name)
        record("AWS/Lambda", "Throttles", 1, "Count")


def _counting_matches(run_rule_actions: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(run_rule_actions)
    async def run(account: str, region: str, rule: dict[str, Any], *rest: Any) -> None:
        if rule and not rule.get("ruleDisabled"):
            record("AWS/IoT", "TopicMatch", 1, "Count", RuleName=rule.get("ruleName", ""))
        await run_rule_actions(account, region, rule, *rest)

    return run


def _counting_actions(dispatch: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(dispatch)
    async def dispatch_action(
        account: str, region: str, rule: str, action: dict[str, Any], event: Any
    ) -> None:
        kind = next(iter(action), "?")
        dimensions = {"RuleName": rule, "ActionType": kind[:1].upper() + kind[1:]}
        try:
            await dispatch(account, region, rule, action, event)
        except Exception:
            record("AWS/IoT", "Failure", 1, "Count", **dimensions)
            raise
        record("AWS/IoT", "Success", 1, "Count", **dimensions)

    return dispatch_action


_PRESENCE = {"connected": "Connect.Success", "connect_failed": "Connect.AuthError"}


def _counting_messages(publish: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        levels = topic.split("/")
        if levels[:3] == ["$aws", "events", "presence"]:
            name = _PRESENCE.get(levels[3])
        else:
            name = "PublishIn.Success"
        if name:
            record("AWS/IoT", name, 1, "Count", Protocol="MQTT")
        await publish(account, region, topic, payload, **rest)

    return broker_publish


# --- reading ---------------------------------------------------------------------------------------


def _searching(get_metric_data: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(get_metric_data)
    def answer(params: Any, request: dict[str, Any], *protocol: Any) -> Any:
        queries = [plain for query in request.get("MetricDataQueries", []) for plain in expand(query)]
        return get_metric_data(
            params, {**request, "MetricDataQueries": queries} if queries else request, *protocol
        )

    return answer


def expand(query: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A query as it is, or for a search one a metric that is found, under the same id."""
    found = _SEARCH.search(query.get("Expression") or "")
    if not found:
        yield query
        return
    namespace, *names = found["schema"].split(",")
    wanted = dict(re.findall(r'(\w+)="([^"]*)"', found["wanted"]))
    metric = wanted.pop("MetricName")
    for key_namespace, key_metric, key_dimensions in list(cloudwatch._metrics.keys()):
        dimensions = dict(part.split("=", 1) for part in key_dimensions.split("|") if part)
        if (key_namespace, key_metric) != (namespace, metric) or dimensions.keys() != set(names):
            continue
        if wanted.items() <= dimensions.items():
            stat = {
                "Metric": {
                    "Namespace": namespace,
                    "MetricName": metric,
                    "Dimensions": [{"Name": k, "Value": v} for k, v in dimensions.items()],
                },
                "Period": int(found["period"]),
                "Stat": found["stat"],
            }
            label = query.get("Label") or dimensions[names[-1]]
            yield {
                **{k: v for k, v in query.items() if k != "Expression"},
                "MetricStat": stat,
                "Label": label,
            }


# --- alarms ----------------------------------------------------------------------------------------


def evaluate(alarm: dict[str, Any]) -> None:
    """Set the state of an alarm by the periods up to now, and tell where it has changed."""
    before = alarm["StateValue"]
    after = "ALARM" if _breaching(alarm, time.time()) else "OK"
    if before == after:
        return
    reason = f"{alarm['MetricName']} {alarm['ComparisonOperator']} {alarm['Threshold']}: {after}"
    alarm |= {"StateValue": after, "StateReason": reason, "StateUpdatedTimestamp": int(time.time())}
    cloudwatch._record_history(alarm["AlarmName"], before, after, reason)
    cloudwatch._dispatch_alarm_actions(alarm, before, after, reason)


def _breaching(alarm: Mapping[str, Any], now_s: float) -> bool:
    """Whether all of the last periods are over the threshold, with or without the one that is running."""
    period, count = int(alarm.get("Period") or 60), int(alarm.get("EvaluationPeriods") or 1)
    dimensions = {d["Name"]: d["Value"] for d in alarm.get("Dimensions") or []}
    key = (alarm.get("Namespace"), alarm.get("MetricName"), cloudwatch._dims_key(dimensions))
    buckets: dict[int, list[Any]] = defaultdict(list)
    with _lock:
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


def _tick(region: str) -> None:
    set_request_region(region)
    while True:
        time.sleep(_TICK_S)
        for queue in list(sqs._queues.values()):
            sqs._refresh_counts(queue)
            waiting = float(queue["attributes"]["ApproximateNumberOfMessages"])
            name = queue["attributes"]["QueueArn"].rsplit(":", 1)[-1]
            record("AWS/SQS", "ApproximateNumberOfMessagesVisible", waiting, "Count", QueueName=name)
        cloudwatch._evaluate_all_alarms()
        oldest_s = time.time() - _KEPT_S
        with _lock:
            for key, points in list(cloudwatch._metrics.items()):
                cloudwatch._metrics[key] = [point for point in points if point["Timestamp"] >= oldest_s]
