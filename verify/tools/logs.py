"""What a function has logged."""

from __future__ import annotations

from testkit.target import Target


def lines(target: Target, function: str, since_ms: int) -> list[str]:
    """The messages in the log of a function since that time, in order."""
    configuration = target.cloud.client("lambda").get_function_configuration(FunctionName=function)
    pages = (
        target.cloud.client("logs")
        .get_paginator("filter_log_events")
        .paginate(logGroupName=configuration["LoggingConfig"]["LogGroup"], startTime=since_ms)
    )
    return [event["message"].strip() for page in pages for event in page["events"]]
