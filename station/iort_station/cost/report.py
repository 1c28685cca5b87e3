"""The cost model's tables as rows of text, for the command, the README and the bench; and a fleet's needs
compared with AWS' default quotas, to find the one that is used up first. Pure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from iort_contract.cloud import PUBNUB
from iort_station.cost import model
from iort_station.cost.model import LineItem, bill, dollars_per_month, pubnub_bill, thesis_bill, total
from iort_station.cost.prices import AS_OF, LISTED, PRICES, QUOTAS, REGION, Listed, Price, Quota
from iort_station.cost.usage import Usage, variations

# The agent waits at least this long before it reconnects; a test compares it with the agent.
SHORTEST_RECONNECT_S = 1.0
_RESERVED = "Lambda 1: concurrency reserved by this deployment"
# Quotas of one robot, which has its own connection and partition keys.
_ONE_ROBOTS = frozenset(
    {
        "IoT Core: publishes of one connection",
        "IoT Core: connects of one client id",
        "DynamoDB: writes to one partition",
    }
)
# The table of a robot-hour has no rows below this; the totals include them.
_LEAST_DOLLARS = 0.00005


class Need(NamedTuple):
    """A fleet's need of one quota, and the number of robots that use it up; None means never."""

    name: str
    needed: float
    quota: Quota
    robots_at_quota: float | None

    @property
    def times(self) -> float:
        """The need as a multiple of the quota."""
        return self.needed / self.quota.value


def needs(usage: Usage) -> list[Need]:
    """What a fleet whose robots all drive at once needs of the quotas, in the order in which they are used
    up."""
    of_one = _per_robot(usage)
    quotas = dict(QUOTAS)
    if usage.live_concurrency:
        quotas[_RESERVED] = Quota(usage.live_concurrency, "executions")
    rows = []
    for name, quota in quotas.items():
        grows = name not in _ONE_ROBOTS
        at = quota.value / of_one[name] if grows and of_one[name] else None
        rows.append(Need(name, of_one[name] * (usage.robots if grows else 1), quota, at))
    return sorted(rows, key=lambda need: need.robots_at_quota or float("inf"))


def _per_robot(usage: Usage) -> dict[str, float]:
    sizes = model.sizes_of(usage.rate_hz, usage.batch_s)
    item_writes, second_writes = (
        model.units(size, model.WRITE) for size in (sizes.telemetry_item, sizes.summary_item)
    )
    batches, own, clock = usage.batches_per_s, usage.own_batches_per_s, usage.clock_pings_per_s
    publishes = batches + own + usage.live_hz + 3 * usage.ping_hz + clock
    # Two more rules evaluate each live message that passes the broker. The stream's shards limit Lambda 2, so
    # only Lambda 1 and the pings count.
    is_pubnub = usage.live_transport == PUBNUB
    by_pubnub = usage.live_hz * is_pubnub
    live_rules = by_pubnub + 2 * (usage.live_at_broker_per_s if is_pubnub else usage.live_hz)
    live_s = by_pubnub * usage.live_ms / 1000
    return {
        _RESERVED: live_s,
        "IoT Core: connections": 1,
        "IoT Core: connects in a minute after an outage": 1,
        "IoT Core: connects of one client id": 1 / SHORTEST_RECONNECT_S,
        "IoT Core: subscriptions": model.SUBSCRIPTIONS,
        # Basic Ingest passes the same gateway.
        "IoT Core: publishes in": publishes,
        "IoT Core: rule evaluations": batches + own + live_rules + 2 * usage.ping_hz + clock,
        "IoT Core: publishes of one connection": publishes,
        "DynamoDB: writes to table telemetry": batches * item_writes + own,
        "DynamoDB: writes to table summary": batches * second_writes + own,
        "DynamoDB: writes to one partition": usage.stream_batches_per_s * item_writes,
        "Lambda: concurrent executions": live_s + usage.ping_hz * 0.005,
    }


class Rows(NamedTuple):
    """A table: its column names and its rows."""

    head: tuple[str, ...]
    body: list[tuple[str, ...]]


def robot_hour(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour by service and lane, in the thesis' layout and in ours; ours also for an hour in
    which nobody looks."""
    alone = replace(usage, watched_hours=0.0)
    columns = thesis_bill(usage, prices), bill(usage, prices), bill(alone, prices)
    body: list[tuple[str, ...]] = []
    # By service; its lanes as the bills have them.
    kinds = dict.fromkeys((item.service, item.lane) for items in columns for item in items)
    for service, lane in sorted(kinds, key=lambda kind: kind[0]):
        sums = [
            total(item for item in items if (item.service, item.lane) == (service, lane)) for items in columns
        ]
        if max(sums) >= _LEAST_DOLLARS:
            shown = (dollars(value) if value >= _LEAST_DOLLARS else "" for value in sums)
            body.append((f"{service}, {lane}", *shown, ""))
    for what, counts in (
        ("total AWS", lambda _: True),
        ("total AWS without log lines", lambda item: item.price != "logs"),
        ("total AWS without archive and analysis", lambda item: item.lane not in {"archive", "analysis"}),
    ):
        body.append(_compared(what, [total(filter(counts, items)) for items in columns]))
    pubnub = [
        total(items)
        for items in (
            pubnub_bill(usage, prices, thesis=True),
            pubnub_bill(usage, prices),
            pubnub_bill(alone, prices),
        )
    ]
    body.append(_compared("PubNub, plan by transactions", pubnub))
    return Rows(("dollars a robot-hour", "a message a sample", "iort", "nobody looks", "ratio"), body)


def _compared(what: str, sums: Sequence[float]) -> tuple[str, ...]:
    return what, *map(dollars, sums), f"1/{sums[0] / sums[1]:.1f}" if sums[1] else ""


def month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per month for the fleet, and for the deployment itself."""

    def driving(items: list[LineItem]) -> str:
        return f"{dollars_per_month(items, usage):,.2f}"

    users = model.pubnub_mau_dollars_per_month(usage)
    fixed = model.deployment_dollars_per_month(usage, prices)
    body: list[tuple[str, ...]] = [
        ("AWS, the driving", driving(bill(usage, prices))),
        *((f"AWS, {name}", f"{value:,.2f}") for name, value in fixed.items()),
        ("AWS, the same driving a message a sample", driving(thesis_bill(usage, prices))),
        ("PubNub, plan by transactions", driving(pubnub_bill(usage, prices))),
        ("PubNub, plan by monthly active users", "ask PubNub" if users is None else f"{users:,.2f}"),
    ]
    return Rows((f"dollars a month, {robots(usage.robots)}", ""), body)


def robot_year(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """What a robot records in a year, in DynamoDB beside the archive."""
    body: list[tuple[str, ...]] = [
        (place.what, f"{place.size_bytes / 1e9:.2f}", dollars(place.dollars))
        for place in model.robot_year(usage, prices)
    ]
    return Rows((f"a robot-year, {usage.hours_per_day:g} h a day", "GB", "dollars"), body)


def differences(listed: Listed) -> Rows:
    """The differences between AWS' price list and the built-in prices."""
    body: list[tuple[str, ...]] = [
        (f"{name}: {PRICES[name].per:,.0f} x {PRICES[name].unit}", f"{ours:g}", f"{aws:g}")
        for name, (ours, aws) in listed.changed().items()
    ]
    body.append((f"as built in: {len(listed.each) - len(body)} of {len(LISTED)}", "", ""))
    return Rows(("dollars", f"{AS_OF}, {REGION}", f"{listed.read_on}, {listed.region}"), body)


def what_if(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour with one setting changed at a time, compared with the thesis' layout."""
    body: list[tuple[str, ...]] = []
    for name, other in variations(usage):
        ours, thesis, pubnub = (total(of(other, prices)) for of in (bill, thesis_bill, pubnub_bill))
        body.append((name, dollars(ours), f"1/{thesis / ours:.1f}", dollars(pubnub)))
    return Rows(("dollars a robot-hour", "AWS", "of a message a sample", "PubNub by transactions"), body)


def quotas(usage: Usage) -> Rows:
    """The fleet's needs of each default quota; the quota that is used up first is on top."""
    body: list[tuple[str, ...]] = []
    for need in needs(usage):
        at = "never" if need.robots_at_quota is None else f"{need.robots_at_quota:,.0f}"
        quota = f"{need.quota.value:,.0f} {need.quota.unit}{'' if need.quota.adjustable else ', fixed'}"
        body.append((need.name, f"{need.needed:,.1f}", quota, times(need.times), at))
    return Rows((robots(usage.robots), "needed", "quota", "times", "robots at the quota"), body)


def robots(number: int) -> str:
    """The number, with its noun."""
    return f"{number:,} robot{'s' * (number != 1)}"


def times(value: float) -> str:
    """A multiple with two digits, or a whole number from 10 on."""
    if value >= 10:
        return f"{value:,.0f}"
    return f"{value:.2g}" if value >= 0.001 else "< 0.001"


def dollars(value: float) -> str:
    """Dollars with their cents, or with four digits below one."""
    return f"{value:.4f}" if value < 1 else f"{value:,.2f}"
