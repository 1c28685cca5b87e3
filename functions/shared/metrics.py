"""Metrics as log lines in CloudWatch's embedded metric format (EMF): no API call, no waiting."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence

from functions.shared.clients import variables
from iort_contract.catalog.environments import Environment
from iort_contract.catalog.metrics import (
    METRIC_DEPLOYMENT,
    METRIC_FUNCTION,
    METRIC_NAMESPACE,
    METRIC_ROBOT,
    METRICS,
)

# "Specification: Embedded metric format": the most values of a metric in one line.
MOST_VALUES = 100
# Values are gathered for this long: a line's frame is 400 bytes, a value in it seven.
GATHER_S = 10.0
# "MetricDatum": CloudWatch rejects larger values, together with the rest of the line, also of other robots.
_MOST = 2.0**360

Values = Mapping[str, float | Sequence[float]]
Write = Callable[[str, Values, float], None]


def emit(function: str, *, robot: str | None = None, **values: float | Sequence[float]) -> None:
    """`write` the values with the current time."""
    write(function, values, time.time(), robot)


def write(function: str, values: Values, at_s: float, robot: str | None = None) -> None:
    """Write the values that are not zero as one EMF line to standard output.

    A list holds several values of one metric; the newest hundred are written. A value beyond CloudWatch's
    limits is set to the limit. With a ``robot`` the values also count for that robot alone. The time is
    ``at_s``, in seconds since the epoch. The deployment's namespace is a dimension, so that two stages in one
    account do not add up. Raises KeyError for a metric that is not the function's in the catalogue.
    """
    for name in values:
        if METRICS[name].function != function:
            raise KeyError(f"{function}: {name}")
    shown = {
        name: [_bounded(each) for each in value[-MOST_VALUES:]]
        if isinstance(value, Sequence)
        else _bounded(value)
        for name, value in values.items()
        if value
    }
    if not shown:
        return
    dimensions = {METRIC_DEPLOYMENT: variables(Environment).namespace, METRIC_FUNCTION: function}
    sets = [list(dimensions)]
    if robot is not None:
        sets.append([*dimensions, METRIC_ROBOT])
        dimensions[METRIC_ROBOT] = robot
    metrics = [{"Name": name, "Unit": METRICS[name].unit} for name in shown]
    directive = {"Namespace": METRIC_NAMESPACE, "Dimensions": sets, "Metrics": metrics}
    line = {
        "_aws": {"Timestamp": int(at_s * 1000), "CloudWatchMetrics": [directive]},
        **dimensions,
        **shown,
    }
    print(json.dumps(line, separators=(",", ":")))  # noqa: T201 - the log line is the metric


class Gathered:
    """Collects the metrics of a frequently called function, some seconds in one line.

    The first values of an environment are written at once. If AWS ends the environment, the unwritten ones
    are lost: less than `GATHER_S` of counts and delays. Failures are not collected here.
    """

    def __init__(self, function: str, into: Write = write) -> None:
        self._function, self._write = function, into
        self._values: dict[str, list[float]] = {}
        self._newest_s = self._written_s = -math.inf

    def add(self, now_s: float, **values: float) -> None:
        """Add the values that are not zero; ``now_s`` is in seconds since the epoch. Counts are added; other
        values are listed, rounded to a hundredth."""
        if self._values and now_s - self._newest_s >= GATHER_S:
            # After a pause in the calls, the rest belongs to the minute before.
            self._flush(self._newest_s)
        self._newest_s = now_s
        for name, value in values.items():
            if not value:
                continue
            kept = self._values.setdefault(name, [])
            if METRICS[name].unit != "Count":
                kept.append(round(value, 2))
            else:
                kept[:] = [sum(kept) + value]
        full = any(len(kept) == MOST_VALUES for kept in self._values.values())
        if full or now_s - self._written_s >= GATHER_S:
            self._flush(now_s)

    def _flush(self, at_s: float) -> None:
        gathered, self._values = self._values, {}
        self._written_s = at_s
        shown = {name: kept[0] if len(kept) == 1 else kept for name, kept in gathered.items()}
        self._write(self._function, shown, at_s)


def _bounded(value: float) -> float:
    # JSON's true is not a metric value, so a bool becomes a number.
    return +max(-_MOST, min(_MOST, value))
