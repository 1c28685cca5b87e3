"""Metrics of Lambda.

AWS: counts every invocation, for each function and for the account
  (https://docs.aws.amazon.com/lambda/latest/dg/monitoring-metrics-types.html).
ministack: counts synchronous invocations only, and has neither concurrency nor the age of a stream's records.
Test: tests/local/operations/test_metrics.py::test_an_invocation_is_counted
Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every
  invocation
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest.mock import patch

from ministack.services import cloudwatch, lambda_svc

from local.gaps.parts.points import record

_running: dict[str, int] = defaultdict(int)


def install() -> None:
    """Close the gap in this process."""
    lambda_svc._execute_function_dispatch = counting_invocations(lambda_svc._execute_function_dispatch)
    # ministack counts synchronous invocations here; they are counted above.
    lambda_svc._emit_lambda_metrics = _count_throttles


def is_open() -> bool:
    """Run a function that a proxy would run, and look for its metric."""
    function = {"config": {"FunctionName": "gaps-lambda-metrics"}}
    with patch.multiple(
        lambda_svc,
        _proxy_url_for=lambda _config: "http://nowhere",
        _execute_function_proxy=lambda *_: {"body": None},
        _emit_lambda_logs=lambda *_, **__: None,
    ):
        lambda_svc._execute_function_dispatch(function, function["config"], {}, "id", time.time())
    return ("AWS/Lambda", "Invocations", "FunctionName=gaps-lambda-metrics") not in cloudwatch._metrics


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
