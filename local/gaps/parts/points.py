"""The points of ministack's metrics: adds values to the current minute, and forgets old ones."""

from __future__ import annotations

import threading
import time

from ministack.services import cloudwatch

LOCK = threading.Lock()
_MINUTE_S = 60
_KEPT_S = 3 * 3600
# Different values of a minute that are kept for percentiles; more values only raise their counts.
_VALUES = 120


def record(namespace: str, name: str, value: float, unit: str, **dimensions: str) -> None:
    """Add a value to the current minute."""
    minute = int(time.time()) // _MINUTE_S * _MINUTE_S
    with LOCK:
        bucket = cloudwatch._metric_bucket((namespace, name, cloudwatch._dims_key(dimensions)))
        running = [point for point in bucket[-_VALUES:] if point["Timestamp"] == minute]
        same = next((point for point in running if point["Value"] == value), None)
        if same is None and len(running) == _VALUES:
            same = running[int(sum(point["Count"] for point in running)) % _VALUES]
        if same is not None:
            same["Count"] += 1.0
            return
        bucket.append(
            {
                "Timestamp": minute,
                "Value": float(value),
                "Count": 1.0,
                "Unit": unit,
                "Dimensions": dict(dimensions),
            }
        )


def forget_old() -> None:
    """Delete the points of more than three hours ago."""
    oldest_s = time.time() - _KEPT_S
    with LOCK:
        for key, points in list(cloudwatch._metrics.items()):
            cloudwatch._metrics[key] = [point for point in points if point["Timestamp"] >= oldest_s]
