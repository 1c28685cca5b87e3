"""The number of logs that are kept.

AWS: does not apply; it keeps a log group's events on disks
  (https://docs.aws.amazon.com/AmazonCloudWatch/latest/logs/Working-with-log-groups-and-streams.html).
ministack: keeps a log stream for each invocation in memory, for ever. Here a group keeps its newest ones, and
  as many of those that have a warning or an error.
Test: tests/local/gaps/test_log_gap.py::test_a_group_keeps_its_newest_logs_and_its_errors
Patch: none; which logs are worth their memory is not for ministack to say
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

from ministack.services import cloudwatch_logs, lambda_svc

KEPT = 500
# So many streams more are there before some are deleted: all have to be looked at.
_SLACK = 100
_EVENTFUL = ("[WARNING]", "[ERROR]", "[CRITICAL]", "Traceback ", "Task timed out")


def install() -> None:
    """Close the gap in this process."""
    lambda_svc._emit_lambda_logs = _forgetting(lambda_svc._emit_lambda_logs)


def is_open() -> bool:
    """Look at the source: no number of invocations shows that none is ever forgotten."""
    return "retentionInDays" not in inspect.getsource(cloudwatch_logs._append_log_events)


def _forgetting(emit: Callable[..., None]) -> Callable[..., None]:
    @wraps(emit)
    def emit_logs(function: dict[str, Any], *arguments: Any, **options: Any) -> None:
        emit(function, *arguments, **options)
        config = function.get("config") or function
        name = (config.get("LoggingConfig") or {}).get(
            "LogGroup"
        ) or f"/aws/lambda/{config.get('FunctionName', 'unknown')}"
        if group := cloudwatch_logs._log_groups.get(name):
            forget(group["streams"])

    return emit_logs


def forget(streams: dict[str, dict[str, Any]], kept: int = KEPT) -> None:
    """Delete the oldest streams; they are in the order of their beginnings."""
    if len(streams) <= 2 * kept + _SLACK:
        return
    names = list(streams)
    old = names[:-kept]
    eventful = [name for name in old if _is_eventful(streams[name])]
    for name in set(old).difference(eventful[-kept:]):
        streams.pop(name, None)


def _is_eventful(stream: Mapping[str, Any]) -> bool:
    return any(str(event["message"]).startswith(_EVENTFUL) for event in stream["events"])
