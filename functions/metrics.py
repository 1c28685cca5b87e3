"""Metrics as log lines in CloudWatch's embedded metric format: no API call, no waiting."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence

from contract import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRIC_ROBOT, METRICS

# "Specification: Embedded metric format": so many values may a metric have in one line.
_MOST_VALUES = 100


def emit(function: str, *, robot: str | None = None, **values: float | Sequence[float]) -> None:
    """Write the values that are not zero as one EMF line to standard output.

    A list is so many values of one metric, of which the newest hundred are written. With a ``robot``
    the same is counted for that robot alone as well.
    ``function`` and the metric names must be the contract's; a name it does not know is a KeyError,
    so that no dashboard can wait for a metric that nothing emits.
    The deployment's ``NAMESPACE`` is a dimension: two stages in one account do not add up.
    Source of the format: CloudWatch, "Specification: Embedded metric format".
    """
    known = METRICS[function]
    shown = {
        name: list(value)[-_MOST_VALUES:] if isinstance(value, Sequence) else value
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
        "_aws": {"Timestamp": int(time.time() * 1000), "CloudWatchMetrics": [directive]},
        **dimensions,
        **shown,
    }
    print(json.dumps(line, separators=(",", ":")))  # noqa: T201 the log line is the metric


def _unit(name: str) -> str:
    if name.endswith("Bytes"):
        return "Bytes"
    if name.endswith(("Volts", "DegC")):
        return "None"
    return "Milliseconds" if name.endswith("Ms") else "Count"
