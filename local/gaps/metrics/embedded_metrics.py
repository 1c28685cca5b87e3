"""Metrics in a function's log.

AWS: makes metrics of log lines in the embedded metric format
  (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/CloudWatch_Embedded_Metric_Format_Specification.html).
ministack: stores the lines as text only.
Test: tests/local/test_metrics.py::test_what_a_function_prints_is_a_metric
Patch: none; it needs ministack's own store to merge the values of a minute, or memory grows with every line
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import lambda_svc

from local.gaps.parts.points import record


def install() -> None:
    """Close the gap in this process."""
    lambda_svc._execute_function_dispatch = _reading_logs(lambda_svc._execute_function_dispatch)


def is_open() -> bool:
    """Look at the source: to show it, a function would have to run."""
    return "CloudWatchMetrics" not in inspect.getsource(lambda_svc)


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
