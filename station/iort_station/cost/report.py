"""The cost model's tables as rows of text, for the command, the README and the bench; with them what a fleet
needs of AWS' default quotas, a deployment's own month, whoever drives, and what incidents and imports cost.
Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.messages.files import PART_BYTES
from iort_station.cost import model
from iort_station.cost.model import (
    ARCHIVED_SHARE,
    READ,
    WRITE,
    bill,
    dollars_per_month,
    pubnub_bill,
    thesis_bill,
    total,
    units,
)
from iort_station.cost.prices import AS_OF, MONTH_DAYS, MONTH_HOURS, PRICES, REGION
from iort_station.cost.usage import Usage

# The agent waits at least this long before it reconnects; a test compares it with the agent.
SHORTEST_RECONNECT_S = 1.0
# The table of a robot-hour has no rows below this; the totals include them.
_LEAST_DOLLARS = 0.00005
# The samples that tell of an incident, each a batch of its own: opened, uploaded.
_INCIDENT_SAMPLES = 2
# Seconds and gigabytes of the function that signs addresses, as of a file of one request.
_SIGNING_S, _SIGNING_GB = 0.1, 0.25


class Need(NamedTuple):
    """A fleet's need of one default quota, and the number of robots that use it up; None means never.

    AWS raises quotas on request, except the ``fixed`` ones, which are of one robot: it has its own connection
    and partition keys.
    """

    name: str
    needed: float
    quota: float
    unit: str
    fixed: bool
    robots_at_quota: float | None

    @property
    def times(self) -> float:
        """The need as a multiple of the quota."""
        return self.needed / self.quota


def needs(usage: Usage) -> list[Need]:
    """What a fleet whose robots all drive at once needs of the quotas, in the order in which they are used
    up.

    IoT Core's are of https://docs.aws.amazon.com/general/latest/gr/iot-core.html. The others are of the same
    services' developer guides: DynamoDB's ServiceQuotas and bp-partition-key-design, Lambda's
    gettingstarted-limits. A new account may have lower quotas, such as of Lambda's executions.
    """
    sizes = model.sizes_of(usage.rate_hz, usage.batch_s)
    batches, own, clock = usage.batches_per_s, usage.own_batches_per_s, usage.clock_pings_per_s
    publishes = batches + own + usage.live_hz + 3 * usage.ping_hz + clock
    if usage.video_minutes * usage.video_broker:
        publishes += usage.picture_hz
    # Two more rules evaluate each live message that passes the broker. The stream's shards limit Lambda 2, so
    # only Lambda 1 and the pings count.
    by_pubnub = usage.live_hz if usage.live_transport == PUBNUB else 0.0
    live_rules = by_pubnub + 2 * (usage.live_at_broker_per_s if by_pubnub else usage.live_hz)
    live_s = by_pubnub * usage.live_ms / 1000
    item_writes, second_writes = (units(size, WRITE) for size in (sizes.telemetry_item, sizes.summary_item))
    # The quota and its unit, and a robot's need.
    quotas = {
        # Confirmed: docs.espressif.com, specs/limits of RainMaker Neo, undated copy.
        "IoT Core: connections": (500_000, "connections", 1),
        # The lower of two: AWS' pages of 2019 to 2023 say 500 a second, later ones 3,000 in most regions.
        # Service Quotas shows an account's own.
        "IoT Core: connects in a minute after an outage": (500 * 60, "connects", 1),
        "IoT Core: subscriptions": (500_000, "subscriptions", model.SUBSCRIPTIONS),
        # Basic Ingest passes the same gateway.
        "IoT Core: publishes in": (20_000, "1/s", publishes),
        "IoT Core: rule evaluations": (20_000, "1/s", batches + own + live_rules + 2 * usage.ping_hz + clock),
        # Confirmed by undated copies of the pages: writes to both tables, and Lambda's executions.
        "DynamoDB: writes to table telemetry": (40_000, "units/s", batches * item_writes + own),
        "DynamoDB: writes to table summary": (40_000, "units/s", batches * second_writes + own),
        "Lambda: concurrent executions": (1_000, "executions", live_s + usage.ping_hz * 0.005),
    }
    if usage.live_concurrency:
        reserved = "Lambda 1: concurrency reserved by this deployment"
        quotas[reserved] = (usage.live_concurrency, "executions", live_s)
    of_one = {
        # Confirmed: repost.aws, question QUshJCmEV8SOSkAJ00SWfQ4Q, undated copy.
        "IoT Core: publishes of one connection": (100, "1/s", publishes),
        # Confirmed by an undated copy of the page.
        "IoT Core: connects of one client id": (1, "1/s", 1 / SHORTEST_RECONNECT_S),
        "DynamoDB: writes to one partition": (1_000, "units/s", usage.stream_batches_per_s * item_writes),
    }
    rows = [
        Need(name, need * usage.robots, quota, unit, False, quota / need if need else None)
        for name, (quota, unit, need) in quotas.items()
    ]
    rows += [Need(name, need, quota, unit, True, None) for name, (quota, unit, need) in of_one.items()]
    return sorted(rows, key=lambda need: need.robots_at_quota or float("inf"))


class Rows(NamedTuple):
    """A table: its column names and its rows."""

    head: tuple[str, ...]
    body: list[tuple[str, ...]]


def robot_hour(usage: Usage) -> Rows:
    """By service and lane, in the thesis' layout and in ours; ours also while nobody looks."""
    alone = replace(usage, watched_hours=0.0)
    columns = thesis_bill(usage), bill(usage), bill(alone)
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
    pubnub = pubnub_bill(usage, thesis=True), pubnub_bill(usage), pubnub_bill(alone)
    body.append(_compared("PubNub, plan by transactions", [total(items) for items in pubnub]))
    return Rows(("dollars a robot-hour", "a message a sample", "iort", "nobody looks", "ratio"), body)


def _compared(what: str, sums: Sequence[float]) -> tuple[str, ...]:
    return what, *map(dollars, sums), f"1/{sums[0] / sums[1]:.1f}" if sums[1] else ""


def month(usage: Usage) -> Rows:
    """Dollars per month for the fleet, and for the deployment itself."""
    ours, thesis, pubnub = (
        f"{dollars_per_month(of(usage), usage):,.2f}" for of in (bill, thesis_bill, pubnub_bill)
    )
    users = model.pubnub_mau_dollars_per_month(usage)
    fixed = deployment_dollars_per_month(usage)
    body: list[tuple[str, ...]] = [
        ("AWS, the driving", ours),
        *((f"AWS, {name}", f"{value:,.2f}") for name, value in fixed.items()),
        ("AWS, the same driving a message a sample", thesis),
        ("PubNub, plan by transactions", pubnub),
        ("PubNub, plan by monthly active users", "ask PubNub" if users is None else f"{users:,.2f}"),
    ]
    return Rows((f"dollars a month, {robots(usage.robots)}", ""), body)


# "Amazon CloudWatch pricing", free tier: three dashboards of up to fifty metrics each, ten custom metrics,
# ten alarms that name their metric. A dashboard with more metrics is billed, and so is each metric that a
# Metrics Insights alarm analyses or that GetMetricData returns. It is the whole account's.
FREE_DASHBOARDS, FREE_DASHBOARD_METRICS, FREE_METRICS, FREE_ALARMS = 3, 50, 10, 10
# The live page's refresh interval; CloudWatch's own console is free. With robot_metrics, the searches of the
# last dashboard find so many metrics per robot.
PAGE_REFRESH_S, ROBOT_SEARCHES = 30, 4


def deployment_dollars_per_month(usage: Usage) -> dict[str, float]:
    """Dollars by purpose: metrics, alarms, dashboards, queue polls, and if set the account's own key.

    Costs below a cent are left out, such as of files of code and page. Parameter Store's standard tier, SNS'
    mails, the budget and reading a table's stream are free.
    """
    metrics = len(METRICS) + usage.robots * usage.robot_metrics * len(metrics_of("health"))
    if usage.live_transport == IOT:
        # AWS bills what is written, and nothing calls Lambda 1.
        metrics -= len(metrics_of("live"))
    dashboards = dashboard_metrics(usage)
    small = sum(shown <= FREE_DASHBOARD_METRICS for shown in dashboards)
    # People look at one dashboard at a time; this counts the largest.
    requested = usage.dashboard_hours * 3600 / PAGE_REFRESH_S * max(dashboards, default=0)
    # Lambda polls around the clock, with five long polls of 20 s where concurrency has a limit: the queues of
    # quarantine, batches put off and archive ("Configuring scaling behavior for SQS event source mappings").
    polls = 3 * 5 * MONTH_HOURS * 3600 / 20
    table: dict[str, tuple[str, float]] = {
        "metrics": ("metric", max(0, metrics - FREE_METRICS)),
        "alarms": ("alarm", max(0, usage.alarms - FREE_ALARMS)),
        "alarms by Metrics Insights, at most": ("insights_alarm", usage.insights_metrics),
        "dashboards": ("dashboard", len(dashboards) - min(small, FREE_DASHBOARDS)),
        "metrics requested by the live page": ("metric_request", requested),
        "polling the queues": ("queue_request", polls),
    }
    if usage.video_minutes * usage.video_relayed:
        table["relays' signalling channel"] = ("channel", 1)
    if usage.customer_key:
        # SQS requests the queue's key every five minutes (KmsDataKeyReusePeriodSeconds).
        table["key"] = ("key", 1)
        table["requests to the key, by the queue"] = ("key_request", 12 * MONTH_HOURS)
    return {what: count * PRICES[price].each for what, (price, count) in table.items()}


def dashboard_metrics(usage: Usage) -> tuple[int, ...]:
    """The number of metrics on each dashboard, including those that a search finds."""
    if not usage.robot_metrics or not usage.dashboards:
        return usage.dashboards
    return (*usage.dashboards[:-1], usage.dashboards[-1] + ROBOT_SEARCHES * usage.robots)


def variations(usage: Usage) -> dict[str, Usage]:
    """The usage with one setting changed at a time."""
    rates = {f"live lane at {hz:g} Hz": {"live_hz": hz} for hz in (5.0, 2.0, 1.0) if hz != usage.live_hz}
    changes: dict[str, dict[str, Any]] = {
        "as configured": {},
        "nobody looks": {"watched_hours": 0.0},
        "somebody looks a tenth of the time": {"watched_hours": 0.1 * usage.hours_per_day},
        "live messages by PubNub": {"live_transport": PUBNUB},
        **rates,
        "no live lane": {"live_hz": 0.0},
        "batches of 0.2 s": {"batch_s": 0.2},
        "one sample a batch": {"batch_s": 0.0},
        "round trips measured at 1 Hz": {"ping_hz": 1.0},
        "commands at 10 Hz": {"command_hz": 10.0},
        "a question to the cloud every minute": {"questions_per_hour": 60.0},
        "video for an hour, directly": {"video_minutes": 60.0},
        "video for an hour, by relays": {"video_minutes": 60.0, "video_relayed": 1.0},
        "video for an hour, as pictures over the broker": {"video_minutes": 60.0, "video_broker": 1.0},
        "reconnecting every minute": {"connects_per_hour": 60.0},
        "with Lambda's own log lines": {"function_logs": "all"},
        "kept for 30 days": {"retention_days": 30},
        "without an archive": {"archive_days": 0},
        "kept for ten years in the archive": {"archive_days": 3653},
        "without the nightly analysis": {"drive_minutes": 0.0},
        "tables recoverable to a point in time (`prod`)": {"recoverable": True},
        "a thousand robots": {"robots": 1000},
    }
    return {name: replace(usage, **changed) for name, changed in changes.items()}


def what_if(usage: Usage) -> Rows:
    """Dollars per robot-hour with one setting changed at a time, compared with the thesis' layout."""
    body: list[tuple[str, ...]] = []
    for name, other in variations(usage).items():
        ours, thesis, pubnub = (total(of(other)) for of in (bill, thesis_bill, pubnub_bill))
        body.append((name, dollars(ours), f"1/{thesis / ours:.1f}", dollars(pubnub)))
    return Rows(("dollars a robot-hour", "AWS", "of a message a sample", "PubNub by transactions"), body)


def quotas(usage: Usage) -> Rows:
    """The fleet's needs of each default quota; the quota that is used up first is on top."""
    body: list[tuple[str, ...]] = []
    for need in needs(usage):
        at = "never" if need.robots_at_quota is None else f"{need.robots_at_quota:,.0f}"
        quota = f"{need.quota:,.0f} {need.unit}{', fixed' if need.fixed else ''}"
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


def facts(usage: Usage) -> dict[str, Any]:
    """The whole estimate for JSON, in US dollars."""
    bills = {"items": bill(usage), "thesis_items": thesis_bill(usage), "pubnub_items": pubnub_bill(usage)}
    items = {
        name: [{**item._asdict(), "dollars_per_robot_hour": item.dollars} for item in of]
        for name, of in bills.items()
    }
    return {
        "prices_as_of": AS_OF,
        "region": REGION,
        "usage": asdict(usage),
        **items,
        "dollars_per_robot_hour": total(bills["items"]),
        "thesis_dollars_per_robot_hour": total(bills["thesis_items"]),
        "deployment_dollars_per_month": deployment_dollars_per_month(usage),
        "fleet_dollars_per_month": dollars_per_month(bills["items"], usage),
        "pubnub_mau_dollars_per_month": model.pubnub_mau_dollars_per_month(usage),
        "quotas": [
            {"name": n.name, "needed": n.needed, "quota": n.quota, "robots_at_quota": n.robots_at_quota}
            for n in needs(usage)
        ],
    }


def _incident_units(count: int, size: int) -> dict[str, float]:
    """The units by the price's name of ``count`` incidents of ``size`` bytes in all, stored for a month."""
    parts = max(count, -(-size // PART_BYTES))
    return {
        # The question for addresses and its answer; the samples pass by Basic Ingest.
        "message": 2.0 * count,
        "rule": (1.0 + _INCIDENT_SAMPLES) * count,
        "action": (1.0 + _INCIDENT_SAMPLES) * count,
        "write": float(_INCIDENT_SAMPLES * count),
        "invocation": float(count),
        "compute_arm": _SIGNING_S * _SIGNING_GB * count,
        # A file of several parts is begun and completed, too.
        "s3_put": float(parts + 2 * count),
        "s3_standard": size / 1e9,
    }


def incident_dollars(count: int, size: int) -> tuple[float, float]:
    """Dollars to upload incidents, and to store their files for a month."""
    units = _incident_units(count, size)
    stored = units.pop("s3_standard") * PRICES["s3_standard"].each
    return sum(amount * PRICES[name].each for name, amount in units.items()), stored


# An import of recordings. A recording's bytes in a batch: compressed, and in base64.
_BATCH_SHARE = 0.6
_SECOND_UNITS = 1


@dataclass(frozen=True)
class Imported:
    """What comes into the table or the archive: seconds and hours of all streams together, and the bytes of
    the recordings."""

    seconds: float
    stream_hours: int
    size: int


def table_units(one: Imported, retention_days: float) -> dict[str, float]:
    """The units by the price's name of batches that go into the table."""
    item = one.size * _BATCH_SHARE / max(1.0, one.seconds)
    return {
        # Batch and second; Lambda 2 and the archive read the batch.
        "write": one.seconds * (units(item, WRITE) + _SECOND_UNITS),
        "read": 3 * one.seconds * units(item, READ),
        "invocation": one.seconds / 100,
        "compute_arm": one.seconds * 0.005,
        "storage": one.size * _BATCH_SHARE / 1e9 * retention_days / MONTH_DAYS,
    }


def archive_units(one: Imported) -> dict[str, float]:
    """The units of hours that go straight into the archive; a day is joined later."""
    return {
        "s3_put": 2.0 * one.stream_hours,
        "s3_get": 4.0 * one.stream_hours,
        "write": 6.0 * one.stream_hours,
        "read": 4.0 * one.stream_hours,
        "s3_standard": one.size * ARCHIVED_SHARE / 1e9,
    }


def import_dollars(amounts: dict[str, float]) -> tuple[float, float]:
    """Dollars once, and dollars of storage: of the archive for a month, of the table until it expires."""
    stored = sum(amounts.get(name, 0.0) * PRICES[name].each for name in ("storage", "s3_standard"))
    once = sum(amount * PRICES[name].each for name, amount in amounts.items()) - stored
    return once, stored
