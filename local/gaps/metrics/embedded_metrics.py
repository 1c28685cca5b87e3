"""Metrics in a function's log.

AWS: makes metrics of log lines in the embedded metric format
  (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/CloudWatch_Embedded_Metric_Format_Specification.html).
ministack: stores the lines as text only.
Test: tests/local/operations/test_metrics.py::test_a_printed_metric_line_is_recorded
Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every line
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest.mock import patch

from ministack.core.responses import request_scope
from ministack.services import cloudwatch, lambda_svc

from local.gaps.parts.points import record


def install() -> None:
    """Close the gap in this process."""
    lambda_svc._execute_function_dispatch = _reading_logs(lambda_svc._execute_function_dispatch)


def is_open() -> bool:
    """Run a function that logs a metric, in an account of its own, and look for the metric."""
    directive = {"Namespace": "gaps", "Dimensions": [[]], "Metrics": [{"Name": "Embedded"}]}
    line = json.dumps({"_aws": {"Timestamp": 0, "CloudWatchMetrics": [directive]}, "Embedded": 1})
    function = {"config": {"FunctionName": "gaps-embedded-metrics"}}
    with (
        request_scope("000000000001", "eu-west-1"),
        patch.multiple(
            lambda_svc,
            _proxy_url_for=lambda _config: "http://nowhere",
            _execute_function_proxy=lambda *_: {"body": None, "log": line},
        ),
    ):
        lambda_svc._execute_function_dispatch(function, function["config"], {}, "id", time.time())
        return ("gaps", "Embedded", "") not in cloudwatch._metrics


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
