"""Invokes functions of the deployment and measures them.

Durations come from Lambda's REPORT lines. On the embedded cloud the operating system measures processor time.
"""

from __future__ import annotations

import base64
import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from testkit import machine
from testkit.target import Target, configure
from testkit.waiting import InstrumentError, reached

_LOGS_S = 60.0
_REPORT = re.compile(r"^REPORT .*?\tDuration: ([\d.]+) ms.*", re.MULTILINE)
_INIT = re.compile(r"Init Duration: ([\d.]+) ms")

# Makes the event of an invocation, by its number in the round.
Event = Callable[[int], dict[str, Any]]


@dataclass
class Measured:
    """The figures of one function in ms.

    ``duration_ms`` has a list for each round. ``cpu_ms`` has the processor time an invocation for each round,
    on the embedded cloud. ``init_ms`` has the start times of new environments.
    """

    duration_ms: list[list[float]] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    init_ms: list[float] = field(default_factory=list)


def measure(target: Target, function: str, event: Event, calls: int, found: Measured) -> None:
    """Invoke the function ``calls`` times, one after the other, and add the round to ``found``.

    Raises `InstrumentError` where an invocation fails, or no REPORT line comes.
    """
    began_ms = int(time.time() * 1000)
    before = _cpu(target)
    told = [invoke(target, function, event(i)) for i in range(calls)]
    if target.embedded is not None:
        found.cpu_ms.append(machine.spent_ms(before, _cpu(target)) / calls)
    # AWS' answers end with the REPORT line; the embedded cloud writes it to the log, which nobody else uses.
    reports = [line for line in told if line is not None]
    if len(reports) < calls:
        reports = _logged(target, function, began_ms, calls)
    found.duration_ms.append([float(match[1]) for line in reports if (match := _REPORT.match(line))])
    found.init_ms += [float(match[1]) for line in reports if (match := _INIT.search(line))]


def _cpu(target: Target) -> dict[int, int]:
    return (
        {}
        if target.embedded is None
        else machine.threads_ns(machine.descendants(target.embedded.emulator.pid))
    )


def invoke(target: Target, function: str, event: dict[str, Any]) -> str | None:
    """Run the function once; return its REPORT line, if the answer has it. Raises `InstrumentError`."""
    answer = target.cloud.client("lambda").invoke(
        FunctionName=function, Payload=json.dumps(event).encode(), LogType="Tail"
    )
    if "FunctionError" in answer:
        raise InstrumentError(f"{function}: {answer['Payload'].read()[:400]!r}")
    return report_line(base64.b64decode(answer.get("LogResult", "")).decode(errors="replace"))


def report_line(tail: str) -> str | None:
    """Return the REPORT line of an invocation's log, if there is one."""
    match = _REPORT.search(tail)
    return None if match is None else match[0]


def _logged(target: Target, function: str, began_ms: int, calls: int) -> list[str]:
    """Wait for the REPORT lines since ``began_ms`` in the function's log, and return them."""
    configuration = target.cloud.client("lambda").get_function_configuration(FunctionName=function)
    group = configuration.get("LoggingConfig", {}).get("LogGroup", f"/aws/lambda/{function}")
    logs = target.cloud.client("logs").get_paginator("filter_log_events")
    reports: list[str] = []

    def all_there() -> bool:
        pages = logs.paginate(logGroupName=group, startTime=began_ms, filterPattern="REPORT")
        lines = (event["message"] for page in pages for event in page["events"])
        reports[:] = [line for line in lines if _REPORT.match(line)]
        return len(reports) >= calls

    if not reached(all_there, within_s=_LOGS_S, poll_s=0.5) and not reports:
        raise InstrumentError(
            f"{group} has no REPORT line after {_LOGS_S:.0f} s: deploy with function_logs=all"
        )
    return reports


@contextmanager
def reporting(target: Target, function: str) -> Iterator[None]:
    """Have Lambda write REPORT lines; the stacks leave them out (`function_logs`)."""
    client = target.cloud.client("lambda")
    was = client.get_function_configuration(FunctionName=function).get("LoggingConfig", {})
    if was.get("LogFormat") != "JSON":
        yield
        return
    try:
        configure(client, function, LoggingConfig={"LogFormat": "Text", "LogGroup": was["LogGroup"]})
        yield
    finally:
        configure(client, function, LoggingConfig=was)
