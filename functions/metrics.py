"""Metrics as log lines in CloudWatch's embedded metric format: no API call, no waiting."""

from __future__ import annotations

import json
import os
import time

from contract import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRICS


def emit(function: str, **values: float) -> None:
    """Write the values that are not zero as one EMF line to standard output.

    ``function`` and the metric names must be the contract's; a name it does not know is a KeyError,
    so that no dashboard can wait for a metric that nothing emits.
    The deployment's ``NAMESPACE`` is a dimension: two stages in one account do not add up.
    Source of the format: CloudWatch, "Specification: Embedded metric format".
    """
    known = METRICS[function]
    shown = {name: value for name, value in values.items() if value}
    for name in values:
        if name not in known:
            raise KeyError(name)
    if not shown:
        return
    metrics = [{"Name": name, "Unit": _unit(name)} for name in shown]
    dimensions = {METRIC_DEPLOYMENT: os.environ["NAMESPACE"], METRIC_FUNCTION: function}
    directive = {"Namespace": METRIC_NAMESPACE, "Dimensions": [list(dimensions)], "Metrics": metrics}
    line = {
        "_aws": {"Timestamp": int(time.time() * 1000), "CloudWatchMetrics": [directive]},
        **dimensions,
        **shown,
    }
    print(json.dumps(line, separators=(",", ":")))  # noqa: T201 the log line is the metric


def _unit(name: str) -> str:
    if name.endswith("Bytes"):
        return "Bytes"
    return "Milliseconds" if name.endswith("Ms") else "Count"
