"""The cost of a run of `make verify-aws`, at list prices, generously estimated."""

from __future__ import annotations

from math import ceil

from iort_station.cost.prices import MONTH_HOURS, PRICES

# A run takes about half an hour; what is metered by the hour is counted for a whole one.
_HOURS = 1.0
# More than all questions together send and invoke (tests/local/gaps/test_verify.py counts them).
MESSAGES, INVOCATIONS, WRITES = 5_000, 2_000, 5_000
_ALARMS, _METRICS, _DASHBOARDS = 40, 200, 3
_GB_SECONDS = INVOCATIONS * 0.5 * 1.0


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
        "a key of one's own": month * each["key"] + 1_000 * each["key_request"],
    }


def told(dollars: dict[str, float]) -> str:
    """The estimate in one line, rounded up to a cent."""
    parts = ", ".join(f"{name} {usd:.3f}" for name, usd in dollars.items())
    return f"about ${ceil(sum(dollars.values()) * 100) / 100:.2f} ({parts})"
