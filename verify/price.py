"""The cost of a run of `make verify-aws`, at list prices, generously estimated."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

from iort_station.cost.prices import MONTH_HOURS, PRICES

# A run takes about an hour (nobody has measured it); what is metered by the hour is counted for two.
_HOURS = 2.0
# More than all questions together send and invoke (tests/local/emulator/test_verify.py counts them).
MESSAGES, INVOCATIONS, WRITES = 5_000, 2_000, 5_000
_ALARMS, _METRICS, _DASHBOARDS = 40, 200, 3
_GB_SECONDS = INVOCATIONS * 0.5 * 1.0
# What single questions use beside that, by the meters of the price list.
BESIDE: Mapping[str, Mapping[str, float]] = {
    "analysis.no_robot": {"transition": 20, "compute_arm": 10},
    "analysis.empty_plan": {"transition": 20, "compute_arm": 10},
    "analysis.one_drive": {"transition": 30, "compute_arm": 60, "express_request": 1},
    "analysis.failing_drive": {
        "transition": 60,
        "compute_arm": 120,
        "express_request": 2,
        "express_duration": 10,
    },
    "analysis.stopped": {"transition": 60, "compute_arm": 120, "express_request": 2, "express_duration": 10},
    "archive.hour_twice": {"compute_arm": 60, "queue_request": 100},
    "archive.late_batch": {"compute_arm": 60, "queue_request": 100},
    "archive.read_back": {"compute_arm": 40, "queue_request": 100},
    "archive.pyarrow_arm64": {"compute_arm": 40, "queue_request": 100},
    "schedules.archive": {"schedule": 1, "compute_arm": 10},
    # A night of the robots that the questions before have registered.
    "schedules.analysis": {"schedule": 1, "transition": 200, "compute_arm": 300},
    "stream.put_off": {"compute_arm": 200, "queue_request": 1_000},
    "functions.ten_at_once": {"compute_arm": 60, "invocation": 100},
}


def estimate() -> dict[str, float]:
    """Dollars by meter."""
    month = _HOURS / MONTH_HOURS
    each = {name: price.each for name, price in PRICES.items()}
    return {
        "messages, rules and actions": MESSAGES * (each["message"] + each["rule"] + 2 * each["action"]),
        "Lambda": INVOCATIONS * each["invocation"] + _GB_SECONDS * each["compute_arm"],
        "DynamoDB": WRITES * (each["write"] + each["read"]),
        "alarms and metrics of an hour": month * (_ALARMS * each["alarm"] + _METRICS * each["metric"]),
        "dashboards of an hour": month * _DASHBOARDS * each["dashboard"],
        "single questions": sum(
            units * each[meter] for used in BESIDE.values() for meter, units in used.items()
        ),
        "a key of one's own": month * each["key"] + 1_000 * each["key_request"],
    }


def told(dollars: dict[str, float]) -> str:
    """The estimate in one line, rounded up to a cent."""
    parts = ", ".join(f"{name} {usd:.3f}" for name, usd in dollars.items())
    return f"about ${ceil(sum(dollars.values()) * 100) / 100:.2f} ({parts})"
