"""Metrics as log lines in CloudWatch's embedded metric format: no API call, no waiting."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence

from iort_contract import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRIC_ROBOT, METRICS

# "Specification: Embedded metric format": so many values may a metric have in one line.
MOST_VALUES = 100
# So long values are gathered: the frame of a line is 400 bytes, a value in it seven.
GATHER_S = 10.0
# "MetricDatum": CloudWatch rejects what is beyond, and with it what else the line holds, of other robots too.
_MOST = 2.0**360

Values = Mapping[str, float | Sequence[float]]
Write = Callable[[str, Values, float], None]


def emit(function: str, *, robot: str | None = None, **values: float | Sequence[float]) -> None:
    """`write` the values, which are of now."""
    write(function, values, time.time(), robot)


def write(function: str, values: Values, at_s: float, robot: str | None = None) -> None:
    """Write the values that are not zero as one EMF line to standard output.

    A list is so many values of one metric, of which the newest hundred are written; a value beyond what
    CloudWatch takes is as large as it takes. With a ``robot``
    the same is counted for that robot alone as well. The values are of ``at_s``, in seconds since the epoch.
    ``function`` and the metric names must be the contract's; a name it does not know is a KeyError,
    so that no dashboard can wait for a metric that nothing emits.
    The deployment's ``NAMESPACE`` is a dimension: two stages in one account do not add up.
    Source of the format: CloudWatch, "Specification: Embedded metric format".
    """
    known = METRICS[function]
    shown = {
        name: [_bounded(each) for each in value[-MOST_VALUES:]]
        if isinstance(value, Sequence)
        else _bounded(value)
        for name, value in values.items()
        if value
    }
    for name in values:
        if name not in known:
            raise KeyError(name)
    if not shown:
        return
    metrics = [{"Name": name, "Unit": _unit(name)} for name in shown]
    dimensions = {METRIC_DEPLOYMENT: os.environ["NAMESPACE"], METRIC_FUNCTION: function}
    sets = [list(dimensions)]
    if robot is not None:
        sets.append([*dimensions, METRIC_ROBOT])
        dimensions[METRIC_ROBOT] = robot
    directive = {"Namespace": METRIC_NAMESPACE, "Dimensions": sets, "Metrics": metrics}
    line = {
        "_aws": {"Timestamp": int(at_s * 1000), "CloudWatchMetrics": [directive]},
        **dimensions,
        **shown,
    }
    print(json.dumps(line, separators=(",", ":")))  # noqa: T201 - the log line is the metric


class Gathered:
    """The metrics of a function that is called many times a second, of some seconds in one line.

    What an environment counts first is written at once. What it has not written when AWS ends it is lost:
    less than `GATHER_S` of counts and delays. Failures do not go this way.
    """

    def __init__(self, function: str, into: Write = write) -> None:
        self._function, self._write = function, into
        self._values: dict[str, list[float]] = {}
        self._newest_s = self._written_s = -math.inf

    def add(self, now_s: float, **values: float) -> None:
        """Count the values that are not zero; ``now_s`` is in seconds since the epoch. Counts are summed,
        of everything else each value is kept to a hundredth."""
        if self._values and now_s - self._newest_s >= GATHER_S:
            # Calls have paused: what is left is of the minute before.
            self._flush(self._newest_s)
        self._newest_s = now_s
        for name, value in values.items():
            if not value:
                continue
            kept = self._values.setdefault(name, [])
            if _unit(name) != "Count":
                kept.append(round(value, 2))
            elif kept:
                kept[0] += value
            else:
                kept.append(value)
        full = any(len(kept) == MOST_VALUES for kept in self._values.values())
        if full or now_s - self._written_s >= GATHER_S:
            self._flush(now_s)

    def _flush(self, at_s: float) -> None:
        gathered, self._values = self._values, {}
        self._written_s = at_s
        shown = {name: kept[0] if len(kept) == 1 else kept for name, kept in gathered.items()}
        self._write(self._function, shown, at_s)


def _bounded(value: float) -> float:
    # A truth value counts as the number that it is in Python: JSON's true is no metric value.
    return +max(-_MOST, min(_MOST, value))


def _unit(name: str) -> str:
    if name.endswith("Bytes"):
        return "Bytes"
    if name.endswith(("Volts", "DegC")):
        return "None"
    return "Milliseconds" if name.endswith("Ms") else "Count"
