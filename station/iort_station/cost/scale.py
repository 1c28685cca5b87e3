"""A fleet's needs compared with AWS' default quotas, to find the quota that is used up first. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from iort_contract.cloud import PUBNUB
from iort_station.cost.bill.line_items import dollars_per_month, total
from iort_station.cost.bill.model import SUBSCRIPTIONS, bill, pubnub_bill
from iort_station.cost.prices import PRICES, QUOTAS, Price, Quota
from iort_station.cost.sizes import sizes_of
from iort_station.cost.usage import Usage

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
    telemetry = usage.batches_per_s * -(-sizes.telemetry_item // 1024) + usage.own_batches_per_s
    summary = usage.batches_per_s * -(-sizes.summary_item // 1024) + usage.own_batches_per_s
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
        "DynamoDB: writes to one partition": usage.stream_batches_per_s * -(-sizes.telemetry_item // 1024),
        "Lambda: concurrent executions": busy,
    }
