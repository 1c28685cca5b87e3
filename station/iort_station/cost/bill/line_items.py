"""The line items of a bill, and the builders that the bills share. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import ceil
from typing import NamedTuple

from iort_station.cost.prices import MONTH_DAYS, PRICES, Price
from iort_station.cost.usage import Usage

METER, WRITE, READ, PUBNUB_UNIT = 5 * 1024, 1024, 4 * 1024, 2048
# "For most use cases, storage is the sum of item sizes, plus 100 bytes an item of indexing overhead."
ITEM_OVERHEAD = 100
# Lambda's own log lines for an invocation.
_REQUEST = "8f507cfc-xmpl-4697-b07a-ac58fc914c95"
PLATFORM_LINES = (
    f"START RequestId: {_REQUEST} Version: $LATEST\n"
    f"END RequestId: {_REQUEST}\n"
    f"REPORT RequestId: {_REQUEST}\tDuration: 12.34 ms\tBilled Duration: 13 ms\t"
    "Memory Size: 256 MB\tMax Memory Used: 81 MB\t\n"
)


class LineItem(NamedTuple):
    """One line of a bill: ``units`` per robot-hour at the price named ``price`` in `PRICES`."""

    service: str
    lane: str
    what: str
    price: str
    units: float
    # Dollars per unit; None means the built-in list price.
    each: float | None = None

    @property
    def dollars(self) -> float:
        """Dollars per robot-hour."""
        return self.units * (PRICES[self.price].each if self.each is None else self.each)


def priced(items: Iterable[LineItem], prices: Mapping[str, Price]) -> list[LineItem]:
    """The items with the given prices."""
    return [item._replace(each=prices[item.price].each) for item in items]


def total(items: Iterable[LineItem]) -> float:
    """Dollars per robot-hour."""
    return sum(item.dollars for item in items)


def by(items: Iterable[LineItem], key: str) -> dict[str, float]:
    """Dollars per robot-hour by ``service`` or ``lane``, the most expensive first."""
    sums: dict[str, float] = {}
    for item in items:
        name = str(getattr(item, key))
        sums[name] = sums.get(name, 0.0) + item.dollars
    return dict(sorted(sums.items(), key=lambda pair: -pair[1]))


def dollars_per_month(items: Iterable[LineItem], usage: Usage) -> float:
    """Dollars per month for the whole fleet."""
    return total(items) * usage.robot_hours_per_month


def units(size: int, unit: int) -> int:
    """The number of billed units of this size."""
    return max(1, ceil(size / unit))


def rules(lane: str, messages: float, size: int) -> list[LineItem]:
    """A rule and its action for messages by Basic Ingest, which have no messaging charge."""
    metered = messages * units(size, METER)
    return [
        LineItem("IoT Core", lane, "rules triggered", "rule", metered),
        LineItem("IoT Core", lane, "actions", "action", metered),
    ]


def storage(lane: str, what: str, count: float, size: int, usage: Usage) -> LineItem:
    """The storage of ``count`` items an hour."""
    gigabyte_months = count * (size + ITEM_OVERHEAD) / 1e9 * usage.retention_days / MONTH_DAYS
    return LineItem("DynamoDB", lane, what, "storage", gigabyte_months)


def function(
    lane: str,
    name: str,
    calls: float,
    usage: Usage,
    *,
    memory_mb: int,
    billed_ms: float,
    logged: float,
    compute: str = "compute_arm",
) -> list[LineItem]:
    """A function's invocations; ``logged`` counts the bytes of its own log lines in an hour."""
    if usage.function_logs == "all":
        logged += calls * len(PLATFORM_LINES)
    return [
        LineItem("Lambda", lane, f"{name} invoked", "invocation", calls),
        LineItem("Lambda", lane, f"{name} computing", compute, calls * memory_mb / 1024 * billed_ms / 1000),
        LineItem("CloudWatch", lane, f"{name} logging", "logs", logged / 1e9),
    ]
