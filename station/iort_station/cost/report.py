"""The cost model's tables as rows of text, for the command, the README and the bench."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from iort_station.cost.bill import analysing, archiving, line_items, model
from iort_station.cost.bill.fixed_costs import deployment_dollars_per_month
from iort_station.cost.price_list import PRODUCTS, Listed
from iort_station.cost.prices import AS_OF, PRICES, REGION, Price
from iort_station.cost.scale import Scale
from iort_station.cost.usage import Usage, variations

# The table of a robot-hour has no rows below this; the totals include them.
_LEAST_DOLLARS = 0.00005
_NOT_IN_THE_THESIS = frozenset({archiving.LANE, analysing.LANE})


class Rows(NamedTuple):
    """A table: its column names and its rows."""

    head: tuple[str, ...]
    body: list[tuple[str, ...]]


def robot_hour(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour by service and lane, in the thesis' layout and in ours; ours also for an hour in
    which nobody looks."""
    alone = replace(usage, watched_hours=0.0)
    ours, thesis, idle = (
        model.bill(usage, prices),
        model.thesis_bill(usage, prices),
        model.bill(alone, prices),
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
        line_items.total(model.pubnub_bill(usage, prices, thesis=True)),
        *(line_items.total(model.pubnub_bill(one, prices)) for one in (usage, alone)),
    ]
    body.append(("PubNub, plan by transactions", *map(_dollars, pubnub), _ratio((pubnub[0], pubnub[1]))))
    head = ("dollars a robot-hour", "a message a sample", "iort", "nobody looks", "ratio")
    return Rows(head, body)


def month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per month for the fleet, and for the deployment itself."""
    aws = line_items.dollars_per_month(model.bill(usage, prices), usage)
    thesis = line_items.dollars_per_month(model.thesis_bill(usage, prices), usage)
    transactions = line_items.dollars_per_month(model.pubnub_bill(usage, prices), usage)
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
        for place in archiving.robot_year(usage, prices)
    ]
    return Rows((f"a robot-year, {usage.hours_per_day:g} h a day", "GB", "dollars"), body)


def differences(listed: Listed) -> Rows:
    """The differences between AWS' price list and the built-in prices."""
    body: list[tuple[str, ...]] = [
        (f"{name}: {PRICES[name].per:,.0f} x {PRICES[name].unit}", f"{ours:g}", f"{aws:g}")
        for name, (ours, aws) in listed.changed().items()
    ]
    same = len(listed.each) - len(body)
    body.append((f"as built in: {same} of {len(PRODUCTS)}", "", ""))
    return Rows(("dollars", f"{AS_OF}, {REGION}", f"{listed.read_on}, {listed.region}"), body)


def what_if(usage: Usage, prices: Mapping[str, Price] = PRICES) -> Rows:
    """Dollars per robot-hour with one setting changed at a time, compared with the thesis' layout."""
    body: list[tuple[str, ...]] = []
    for name, other in variations(usage):
        ours, thesis, pubnub = (
            line_items.total(made(other, prices))
            for made in (model.bill, model.thesis_bill, model.pubnub_bill)
        )
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


def _sum(items: list[line_items.LineItem], service: str, lane: str) -> float:
    return sum(item.dollars for item in items if (item.service, item.lane) == (service, lane))


def _shown(items: list[line_items.LineItem], service: str, lane: str) -> str:
    dollars = _sum(items, service, lane)
    return _dollars(dollars) if dollars >= _LEAST_DOLLARS else ""


def _dollars(dollars: float) -> str:
    return f"{dollars:.4f}" if dollars < 1 else f"{dollars:,.2f}"


def _ratio(both: tuple[float, float]) -> str:
    return f"1/{both[0] / both[1]:.1f}" if both[1] else ""
