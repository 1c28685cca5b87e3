"""The lines of a bill, and the builders that the bills share. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import ceil
from typing import NamedTuple

from iort_station.cost.prices import MONTH_DAYS, PRICES, Price
from iort_station.cost.usage import Usage

METER, WRITE, READ, PUBNUB_UNIT = 5 * 1024, 1024, 4 * 1024, 2048
# "For most use cases, storage is the sum of item sizes, plus 100 bytes an item of indexing overhead."
_ITEM_OVERHEAD = 100
# What Lambda itself writes to the log for every invocation.
_REQUEST = "8f507cfc-xmpl-4697-b07a-ac58fc914c95"
PLATFORM_LINES = (
    f"START RequestId: {_REQUEST} Version: $LATEST\n"
    f"END RequestId: {_REQUEST}\n"
    f"REPORT RequestId: {_REQUEST}\tDuration: 12.34 ms\tBilled Duration: 13 ms\t"
    "Memory Size: 256 MB\tMax Memory Used: 81 MB\t\n"
)


class Item(NamedTuple):
    """One line of a bill: ``units`` a robot-hour of what `PRICES` calls ``price``, for a lane."""

    service: str
    lane: str
    what: str
    price: str
    units: float
    # Dollars for a unit; None is the built-in list price.
    each: float | None = None

    @property
    def dollars(self) -> float:
        """A robot-hour."""
        return self.units * (PRICES[self.price].each if self.each is None else self.each)


def priced(items: Iterable[Item], prices: Mapping[str, Price]) -> list[Item]:
    """The items at these prices."""
    return [item._replace(each=prices[item.price].each) for item in items]


def total(items: Iterable[Item]) -> float:
    """Dollars a robot-hour."""
    return sum(item.dollars for item in items)


def by(items: Iterable[Item], key: str) -> dict[str, float]:
    """Dollars a robot-hour by ``service`` or ``lane``, the dearest first."""
    sums: dict[str, float] = {}
    for item in items:
        name = str(getattr(item, key))
        sums[name] = sums.get(name, 0.0) + item.dollars
    return dict(sorted(sums.items(), key=lambda pair: -pair[1]))


def dollars_per_month(items: Iterable[Item], usage: Usage) -> float:
    """Of the whole fleet."""
    return total(items) * usage.robot_hours_per_month


def units(size: int, unit: int) -> int:
    """How many units of a price something of this size is."""
    return max(1, ceil(size / unit))


def rules(lane: str, messages: float, size: int) -> list[Item]:
    """Of Basic Ingest, which has no messaging charge."""
    metered = messages * units(size, METER)
    return [
        Item("IoT Core", lane, "rules triggered", "rule", metered),
        Item("IoT Core", lane, "actions", "action", metered),
    ]


def storage(lane: str, what: str, count: float, size: int, usage: Usage) -> Item:
    """What is kept of so many items an hour."""
    gigabyte_months = count * (size + _ITEM_OVERHEAD) / 1e9 * usage.retention_days / MONTH_DAYS
    return Item("DynamoDB", lane, what, "storage", gigabyte_months)


def function(
    lane: str,
    name: str,
    calls: float,
    *,
    memory_mb: int,
    billed_ms: float,
    logged: float,
    all_lines: bool = True,
    compute: str = "compute_arm",
) -> list[Item]:
    """``logged`` are the bytes of the function's own lines in an hour."""
    if all_lines:
        logged += calls * len(PLATFORM_LINES)
    return [
        Item("Lambda", lane, f"{name} invoked", "invocation", calls),
        Item("Lambda", lane, f"{name} computing", compute, calls * memory_mb / 1024 * billed_ms / 1000),
        Item("CloudWatch", lane, f"{name} logging", "logs", logged / 1e9),
    ]
