"""Fixes of CloudWatch's metrics: those that ministack does not record, and SEARCH."""

from __future__ import annotations

import json
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from ministack.services import cloudwatch, iot, lambda_svc, sqs

from local.emulator.fixes import alarms
from local.emulator.fixes.alarms import record


def close_embedded_metrics() -> None:
    """Metrics in a function's log.

    AWS: makes metrics of log lines in the embedded metric format
      (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/CloudWatch_Embedded_Metric_Format_Specification.html).
    ministack: stores the lines as text only.
    Test: tests/local/operations/test_metrics.py::test_a_printed_metric_line_is_recorded
    Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every
      line
    """
    lambda_svc._execute_function_dispatch = _reading_logs(lambda_svc._execute_function_dispatch)


def _reading_logs(dispatch: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(dispatch)
    def execute(*arguments: Any) -> Any:
        result = dispatch(*arguments)
        record_log(result.get("log") or "")
        return result

    return execute


def record_log(text: str) -> None:
    """Record the metrics in the lines of a log that have the embedded metric format."""
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


_PRESENCE = {"connected": "Connect.Success", "connect_failed": "Connect.AuthError"}


def close_iot_metrics() -> None:
    """Metrics of AWS IoT.

    AWS: counts connections, messages, and the matches and actions of rules
      (https://docs.aws.amazon.com/iot/latest/developerguide/metrics_dimensions.html).
    ministack: counts none of them.
    Test: tests/local/operations/test_eyes.py::test_a_fault_reaches_a_human_and_the_dashboards
    Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every
      message
    """
    iot._run_rule_actions = _counting_matches(iot._run_rule_actions)
    iot._dispatch_rule_action = _counting_actions(iot._dispatch_rule_action)
    iot.broker_publish = _counting_messages(iot.broker_publish)


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


_running: dict[str, int] = defaultdict(int)


def close_lambda_metrics() -> None:
    """Metrics of Lambda.

    AWS: counts every invocation, for each function and for the account
      (https://docs.aws.amazon.com/lambda/latest/dg/monitoring-metrics-types.html).
    ministack: counts synchronous invocations only, and has neither concurrency nor the age of a stream's
      records.
    Test: tests/local/operations/test_metrics.py::test_an_invocation_is_counted
    Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every
      invocation
    """
    lambda_svc._execute_function_dispatch = counting_invocations(lambda_svc._execute_function_dispatch)
    # ministack counts synchronous invocations here; they are counted above.
    lambda_svc._emit_lambda_metrics = _count_throttles


def counting_invocations(dispatch: Callable[..., Any]) -> Callable[..., Any]:
    """An execution of a function that is counted."""

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
        return result

    return execute


def _age_ms(event: Any) -> float | None:
    """The age of the last record of a stream's batch; None for any other event."""
    records = event.get("Records") if isinstance(event, dict) else None
    if not records or "dynamodb" not in records[-1]:
        return None
    created_s = float(records[-1]["dynamodb"].get("ApproximateCreationDateTime", 0))
    return max(0.0, (time.time() - created_s) * 1000) if created_s else None


def _count_throttles(function_name: str, **counts: Any) -> None:
    if counts.get("throttle"):
        record("AWS/Lambda", "Throttles", 1, "Count", FunctionName=function_name)
        record("AWS/Lambda", "Throttles", 1, "Count")


def close_queue_metrics() -> None:
    """Metrics of SQS.

    AWS: counts the messages that wait in each queue, every minute
      (https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-available-cloudwatch-metrics.html).
    ministack: does not count them.
    Test: tests/local/operations/test_metrics.py::test_waiting_messages_are_counted
    Patch: none; ministack has no clock that could count
    """
    # `alarm_timer` counts each time that it looks.
    alarms.BEFORE_ALARMS.append(count)


def count() -> None:
    """Record how many messages wait in each queue."""
    for queue in list(sqs._queues.values()):
        sqs._refresh_counts(queue)
        waiting = float(queue["attributes"]["ApproximateNumberOfMessages"])
        name = queue["attributes"]["QueueArn"].rsplit(":", 1)[-1]
        record("AWS/SQS", "ApproximateNumberOfMessagesVisible", waiting, "Count", QueueName=name)


_SEARCH = re.compile(
    r"SEARCH\('\{(?P<schema>[^}]+)\} (?P<wanted>[^']+)', '(?P<stat>[^']+)', (?P<period>\d+)\)"
)


def close_metric_search() -> None:
    """SEARCH in GetMetricData.

    AWS: finds the metrics that match, and answers each
      (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/search-expression-syntax.html).
    ministack: answers that expressions are not implemented.
    Test: tests/local/operations/test_metrics.py::test_a_search_finds_a_metric_of_any_action_type
    Patch: none; only the form of SEARCH that our dashboards use is understood here
    """
    cloudwatch._get_metric_data = _searching(cloudwatch._get_metric_data)


def _searching(get_metric_data: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(get_metric_data)
    def answer(params: Any, request: dict[str, Any], *protocol: Any) -> Any:
        queries = [plain for query in request.get("MetricDataQueries", []) for plain in expand(query)]
        return get_metric_data(
            params, {**request, "MetricDataQueries": queries} if queries else request, *protocol
        )

    return answer


def expand(query: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A search gives one query per metric found, under the same id. Any other query stays as it is."""
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
