"""The cost model's tables as rows of text, for the command, the README and the bench; and a fleet's needs
compared with AWS' default quotas, to find the one that is used up first. Pure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from iort_contract.cloud import PUBNUB
from iort_station.cost import model
from iort_station.cost.model import (
    SUBSCRIPTIONS,
    WRITE,
    LineItem,
    bill,
    deployment_dollars_per_month,
    dollars_per_month,
    pubnub_bill,
    sizes_of,
    thesis_bill,
    total,
    units,
)
from iort_station.cost.prices import AS_OF, LISTED, PRICES, QUOTAS, REGION, Listed, Price, Quota
from iort_station.cost.usage import Usage, variations

# The agent waits at least this long before it reconnects; a test compares it with the agent.
SHORTEST_RECONNECT_S = 1.0


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


class Scale(NamedTuple):
    """The estimate for a fleet: needs in the order in which the quotas are used up, and dollars per month."""

    robots: int
    needs: list[Need]
    aws_dollars_per_month: float
    pubnub_dollars_per_month: float
    pubnub_publishes_per_s: float

    @property
    def breaks_first(self) -> Need:
        """The need of the quota that the fewest robots use up."""
        return self.needs[0]


def on_paper(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Scale:
    """The estimate for a fleet whose robots all drive at once."""
    one = _per_robot(usage)
    quotas = dict(QUOTAS)
    if usage.live_concurrency:
        page = "live_concurrency, a parameter of the deployment"
        quotas[_RESERVED] = Quota(usage.live_concurrency, "executions", adjustable=True, page=page)
    needs = [
        Need(
            name,
            one[name] * (1 if name in _ONE_ROBOTS else usage.robots),
            quota,
            None if name in _ONE_ROBOTS or not one[name] else quota.value / one[name],
        )
        for name, quota in quotas.items()
    ]
    needs.sort(key=lambda need: need.robots_at_quota or float("inf"))
    return Scale(
        usage.robots,
        needs,
        dollars_per_month(bill(usage, prices), usage),
        total(pubnub_bill(usage, prices)) * usage.robot_hours_per_month,
        usage.live_hz * usage.robots if usage.live_transport == PUBNUB else 0.0,
    )


_RESERVED = "Lambda 1: concurrency reserved by this deployment"
# Quotas of one robot, which has its own connection and partition keys.
_ONE_ROBOTS = frozenset(
    {
        "IoT Core: publishes of one connection",
        "IoT Core: connects of one client id",
        "DynamoDB: writes to one partition",
    }
)


def _per_robot(usage: Usage) -> dict[str, float]:
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    batches = usage.batches_per_s + usage.own_batches_per_s
    publishes = batches + usage.live_hz + 3 * usage.ping_hz + usage.clock_pings_per_s
    telemetry = usage.batches_per_s * units(sizes.telemetry_item, WRITE) + usage.own_batches_per_s
    summary = usage.batches_per_s * units(sizes.summary_item, WRITE) + usage.own_batches_per_s
    # The stream's shards limit Lambda 2, so only Lambda 1 and the pings count.
    by_pubnub = usage.live_hz if usage.live_transport == PUBNUB else 0.0
    busy = by_pubnub * usage.live_ms / 1000 + usage.ping_hz * 0.005
    # Two more rules evaluate each message that passes the broker.
    passing = usage.live_at_broker_per_s if usage.live_transport == PUBNUB else usage.live_hz
    live_rules = by_pubnub + 2 * passing
    return {
        _RESERVED: by_pubnub * usage.live_ms / 1000,
        "IoT Core: connections": 1,
        "IoT Core: connects in a minute after an outage": 1,
        "IoT Core: connects of one client id": 1 / SHORTEST_RECONNECT_S,
        "IoT Core: subscriptions": SUBSCRIPTIONS,
        # Basic Ingest passes the same gateway.
        "IoT Core: publishes in": publishes,
        "IoT Core: rule evaluations": batches + live_rules + 2 * usage.ping_hz + usage.clock_pings_per_s,
        "IoT Core: publishes of one connection": publishes,
        "DynamoDB: writes to table telemetry": telemetry,
        "DynamoDB: writes to table summary": summary,
        "DynamoDB: writes to one partition": usage.stream_batches_per_s * units(sizes.telemetry_item, WRITE),
        "Lambda: concurrent executions": busy,
    }


# The table of a robot-hour has no rows below this; the totals include them.
_LEAST_DOLLARS = 0.00005
_NOT_IN_THE_THESIS = frozenset({"archive", "analysis"})


class Rows(NamedTuple):
    """A table: its column names and its rows."""

    head: tuple[str, ...]
    body: list[tuple[str, ...]]


def robot_hour(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour by service and lane, in the thesis' layout and in ours; ours also for an hour in
    which nobody looks."""
    alone = replace(usage, watched_hours=0.0)
    ours, thesis, idle = (
        bill(usage, prices),
        thesis_bill(usage, prices),
        bill(alone, prices),
    )
    columns = thesis, ours, idle
    body: list[tuple[str, ...]] = []
    for service in sorted({item.service for items in columns for item in items}):
        lanes = dict.fromkeys(item.lane for items in columns for item in items if item.service == service)
        body.extend(
            (f"{service}, {lane}", *(_shown(items, service, lane) for items in columns), "")
            for lane in lanes
            if max(_sum(items, service, lane) for items in columns) >= _LEAST_DOLLARS
        )
    for what, left_out in (
        ("total AWS", lambda _: False),
        ("total AWS without log lines", lambda item: item.price == "logs"),
        ("total AWS without archive and analysis", lambda item: item.lane in _NOT_IN_THE_THESIS),
    ):
        sums = [sum(item.dollars for item in items if not left_out(item)) for items in columns]
        body.append((what, *map(_dollars, sums), _ratio((sums[0], sums[1]))))
    pubnub = [
        total(pubnub_bill(usage, prices, thesis=True)),
        *(total(pubnub_bill(one, prices)) for one in (usage, alone)),
    ]
    body.append(("PubNub, plan by transactions", *map(_dollars, pubnub), _ratio((pubnub[0], pubnub[1]))))
    head = ("dollars a robot-hour", "a message a sample", "iort", "nobody looks", "ratio")
    return Rows(head, body)


def month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per month for the fleet, and for the deployment itself."""
    aws = dollars_per_month(bill(usage, prices), usage)
    thesis = dollars_per_month(thesis_bill(usage, prices), usage)
    transactions = dollars_per_month(pubnub_bill(usage, prices), usage)
    users = model.pubnub_mau_dollars_per_month(usage)
    body: list[tuple[str, ...]] = [
        ("AWS, the driving", f"{aws:,.2f}"),
        *(
            (f"AWS, {name}", f"{dollars:,.2f}")
            for name, dollars in deployment_dollars_per_month(usage, prices).items()
        ),
        ("AWS, the same driving a message a sample", f"{thesis:,.2f}"),
        ("PubNub, plan by transactions", f"{transactions:,.2f}"),
        ("PubNub, plan by monthly active users", "ask PubNub" if users is None else f"{users:,.2f}"),
    ]
    return Rows((f"dollars a month, {usage.robots:,} robot{'s' * (usage.robots != 1)}", ""), body)


def robot_year(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """What a robot records in a year, in DynamoDB beside the archive."""
    body: list[tuple[str, ...]] = [
        (place.what, f"{place.size_bytes / 1e9:.2f}", _dollars(place.dollars))
        for place in model.robot_year(usage, prices)
    ]
    return Rows((f"a robot-year, {usage.hours_per_day:g} h a day", "GB", "dollars"), body)


def differences(listed: Listed) -> Rows:
    """The differences between AWS' price list and the built-in prices."""
    body: list[tuple[str, ...]] = [
        (f"{name}: {PRICES[name].per:,.0f} x {PRICES[name].unit}", f"{ours:g}", f"{aws:g}")
        for name, (ours, aws) in listed.changed().items()
    ]
    same = len(listed.each) - len(body)
    body.append((f"as built in: {same} of {len(LISTED)}", "", ""))
    return Rows(("dollars", f"{AS_OF}, {REGION}", f"{listed.read_on}, {listed.region}"), body)


def what_if(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour with one setting changed at a time, compared with the thesis' layout."""
    body: list[tuple[str, ...]] = []
    for name, other in variations(usage):
        ours, thesis, pubnub = (total(made(other, prices)) for made in (bill, thesis_bill, pubnub_bill))
        body.append((name, _dollars(ours), f"1/{thesis / ours:.1f}", _dollars(pubnub)))
    return Rows(("dollars a robot-hour", "AWS", "of a message a sample", "PubNub by transactions"), body)


def quotas(scale: Scale) -> Rows:
    """The fleet's needs of each default quota; the quota that is used up first is on top."""
    body: list[tuple[str, ...]] = []
    for need in scale.needs:
        at = "never" if need.robots_at_quota is None else f"{need.robots_at_quota:,.0f}"
        fixed = "" if need.quota.adjustable else ", fixed"
        quota = f"{need.quota.value:,.0f} {need.quota.unit}{fixed}"
        body.append((need.name, f"{need.needed:,.1f}", quota, times(need.times), at))
    return Rows(
        (
            f"{scale.robots:,} robot{'s' * (scale.robots > 1)}",
            "needed",
            "quota",
            "times",
            "robots at the quota",
        ),
        body,
    )


def times(value: float) -> str:
    """A multiple with two digits, or a whole number from 10 on."""
    if value >= 10:
        return f"{value:,.0f}"
    return f"{value:.2g}" if value >= 0.001 else "< 0.001"


def _sum(items: list[LineItem], service: str, lane: str) -> float:
    return sum(item.dollars for item in items if (item.service, item.lane) == (service, lane))


def _shown(items: list[LineItem], service: str, lane: str) -> str:
    dollars = _sum(items, service, lane)
    return _dollars(dollars) if dollars >= _LEAST_DOLLARS else ""


def _dollars(dollars: float) -> str:
    return f"{dollars:.4f}" if dollars < 1 else f"{dollars:,.2f}"


def _ratio(both: tuple[float, float]) -> str:
    return f"1/{both[0] / both[1]:.1f}" if both[1] else ""
