"""What a fleet costs: every unit that is billed, from the configuration, times its list price. Pure.

A `Usage` says how robots are driven, `bill` what that comes to item by item, and `thesis_bill` what the
same driving cost in the layout that the project began from: a message, two items and a push a sample.
"""

from __future__ import annotations

from math import ceil
from typing import Any, NamedTuple

from station.prices import MONTH_DAYS, PRICES, PUBNUB_MAU_PLANS
from station.sizes import Sizes, measure, own_item_bytes
from station.usage import Usage

_METER, _WRITE, _READ, _PUBNUB_UNIT = 5 * 1024, 1024, 4 * 1024, 2048
# "For most use cases, storage is the sum of item sizes, plus 100 bytes an item of indexing overhead."
_ITEM_OVERHEAD = 100
# A shard of a stream is a partition of the table. Lambda 2 is called once a window, or by as many records;
# a test holds both to the stack. The thesis had no window: Lambda polls a shard four times a second.
_PARTITION_WRITES = 1000.0
WINDOW_S, RECORDS_A_CALL = 2.0, 500
_THESIS_POLLS_PER_S, _THESIS_RECORDS_A_CALL = 4.0, 100
# What Lambda itself writes to the log for every invocation.
_REQUEST = "8f507cfc-xmpl-4697-b07a-ac58fc914c95"
_PLATFORM_LINES = (
    f"START RequestId: {_REQUEST} Version: $LATEST\n"
    f"END RequestId: {_REQUEST}\n"
    f"REPORT RequestId: {_REQUEST}\tDuration: 12.34 ms\tBilled Duration: 13 ms\t"
    "Memory Size: 256 MB\tMax Memory Used: 81 MB\t\n"
)
# And ours in bytes, in embedded metric format; a test holds these to functions/. Lambda 1 gathers what it
# counts: a line an environment in `_GATHER_S`, or sooner with a hundred values of one metric; four a message.
_GATHER_S, _MOST_VALUES, _LIVE_LINE, _LIVE_VALUES = 10.0, 100.0, 480, 24
# Lambda 2 writes one about itself, and one about each stream that it was given.
_SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE = 310, 300, 220


class Item(NamedTuple):
    """One line of a bill: ``units`` a robot-hour of what `PRICES` calls ``price``, for a lane."""

    service: str
    lane: str
    what: str
    price: str
    units: float

    @property
    def dollars(self) -> float:
        """A robot-hour."""
        return self.units * PRICES[self.price].each


def bill(usage: Usage) -> list[Item]:
    """What AWS bills a robot-hour, item by item; PubNub apart (`pubnub_bill`)."""
    usage.check()
    sizes = measure(usage.rate_hz, usage.batch_s)
    hour = 3600.0
    batches, own = usage.batches_per_s * hour, usage.own_batches_per_s * hour
    own_item = own_item_bytes("agent", 1)
    items = [Item("IoT Core", "all", "connection", "connection", 60)]
    items += _rule_items("record", batches, sizes.record)
    items += _rule_items("agent, rtt", own, own_item)
    live = usage.live_hz * hour
    items += _rule_items("live", live, sizes.live)
    # Some pass the broker, where two more rules look at them.
    passing = usage.live_at_broker_per_s * hour * _units(sizes.live, _METER)
    items += [
        Item("IoT Core", "live", "messages", "message", passing),
        Item("IoT Core", "live", "rules fault and battery", "rule", 2 * passing),
        Item("IoT Core", "live", "their actions, or the least billed", "action", 2 * passing),
    ]
    clock = usage.clock_pings_per_s * hour
    items += [
        Item("IoT Core", "ping", "the clock's pings and pongs", "message", 2 * clock),
        Item("IoT Core", "ping", "the clock's rule", "rule", clock),
        Item("IoT Core", "ping", "its action", "action", clock),
    ]
    items += _ping_items(usage.ping_hz * hour, sizes, all_lines=usage.function_logs == "all")
    writes = batches * _units(sizes.telemetry_item, _WRITE)
    # Of one stream in an event: its batches, of which one query reads also the second before.
    of_stream = usage.stream_batches_per_s
    found = max(1.0, of_stream * _shards_of(usage) / summarize_calls_per_s(usage))
    read = found + max(1.0, of_stream)
    reads = batches / found * _units(ceil(read) * sizes.telemetry_item, _READ)
    # A batch lies in one second; a second whose batches come in two events is written twice.
    writes_s = batches * min(1.0, 1 / of_stream + (of_stream > 1) / found)
    items += [
        Item("DynamoDB", "record", "telemetry written", "write", writes),
        Item("DynamoDB", "agent, rtt", "telemetry written", "write", own * _units(own_item, _WRITE)),
        Item("DynamoDB", "record", "summary written", "write", writes_s * _units(sizes.summary_item, _WRITE)),
        Item("DynamoDB", "agent, rtt", "summary written", "write", own),
        Item("DynamoDB", "record", "batches read by Lambda 2", "read", reads),
        Item("DynamoDB", "agent, rtt", "batches read by Lambda 2", "read", own),
    ]
    seconds = min(batches, usage.streams * hour)
    kept = [
        _storage("record", "telemetry kept", batches, sizes.telemetry_item, usage),
        _storage("record", "summary kept", seconds, sizes.summary_item, usage),
        _storage("agent, rtt", "kept", 2 * own, own_item, usage),
    ]
    items += kept
    if usage.recoverable:
        items += [item._replace(what=f"{item.what}, recoverable", price="recovery") for item in kept]
    calls = summarize_calls_per_s(usage) * hour / usage.robots
    all_lines = usage.function_logs == "all"
    items += _lambda_items(
        "record",
        "Lambda 2",
        calls,
        memory_mb=usage.summarize_memory_mb,
        billed_ms=usage.summarize_ms + usage.summarize_batch_ms * (batches + own) / calls,
        logged=calls * _SUMMARIZE_LINE + (batches / found + own) * _HEALTH_LINE,
        all_lines=all_lines,
    )
    items += _lambda_items(
        "live",
        "Lambda 1",
        live,
        memory_mb=usage.live_memory_mb,
        billed_ms=usage.live_ms,
        logged=_live_lines_per_s(usage) * hour / usage.robots * _LIVE_LINE + live * _LIVE_VALUES,
        all_lines=all_lines,
    )
    return items


def thesis_bill(usage: Usage) -> list[Item]:
    """The same driving in the thesis' layout: each sample a message through the broker, which triggers
    two rules, one item in each of two tables, and one invocation of Lambda 1; functions of 128 MB on
    x86. Prices, retention and the milliseconds of an invocation are the same as ours; there are no pings,
    no figures of the agent's own, no alarms and no metrics."""
    usage.check()
    sizes = measure(usage.rate_hz, usage.batch_s)
    samples = usage.samples_per_s * 3600
    per_s = usage.robots * usage.samples_per_s
    polls = max(_THESIS_POLLS_PER_S * _shards(per_s), per_s / _THESIS_RECORDS_A_CALL)
    calls = min(per_s, polls) * 3600 / usage.robots
    written = samples * _units(sizes.sample_item, _WRITE)
    functions: dict[str, Any] = {"memory_mb": 128, "logged": 0.0, "compute": "compute_x86"}
    live = _lambda_items("live", "Lambda 1", samples, billed_ms=usage.live_ms, **functions)
    second = _lambda_items("record", "Lambda 2", calls, billed_ms=usage.summarize_ms, **functions)
    return [
        Item("IoT Core", "all", "connection", "connection", 60),
        Item("IoT Core", "record", "messages", "message", samples * _units(sizes.sample, _METER)),
        Item("IoT Core", "record", "rule to the table", "rule", samples),
        Item("IoT Core", "record", "its action", "action", samples),
        Item("IoT Core", "live", "rule to Lambda 1", "rule", samples),
        Item("IoT Core", "live", "its action", "action", samples),
        Item("DynamoDB", "record", "first table written", "write", written),
        Item("DynamoDB", "record", "second table written", "write", written),
        _storage("record", "both tables kept", 2 * samples, sizes.sample_item, usage),
        *second,
        *live,
    ]


def pubnub_bill(usage: Usage, *, thesis: bool = False) -> list[Item]:
    """What PubNub bills a robot-hour on its plan by transactions: a publish each, a receipt a viewer."""
    usage.check()
    size = measure(usage.rate_hz, usage.batch_s).update
    messages = (usage.samples_per_s if thesis else usage.live_hz) * 3600 * _units(size, _PUBNUB_UNIT)
    return [
        Item("PubNub", "live", "published", "pubnub_publish", messages),
        Item("PubNub", "live", "received by viewers", "pubnub_receive", messages * usage.viewers),
    ]


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """PubNub's plan by monthly active users: the viewers and Lambda 1; None above the listed plans."""
    users = usage.viewers + 1
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if users <= most), None)


def total(items: list[Item]) -> float:
    """Dollars a robot-hour."""
    return sum(item.dollars for item in items)


def by(items: list[Item], key: str) -> dict[str, float]:
    """Dollars a robot-hour by ``service`` or ``lane``, the dearest first."""
    sums: dict[str, float] = {}
    for item in items:
        name = str(getattr(item, key))
        sums[name] = sums.get(name, 0.0) + item.dollars
    return dict(sorted(sums.items(), key=lambda pair: -pair[1]))


def summarize_calls_per_s(usage: Usage) -> float:
    """Invocations of Lambda 2 a second, of the whole fleet: one a window and shard, or as many as events
    of five hundred records need."""
    records = usage.robots * (usage.batches_per_s + usage.own_batches_per_s)
    return min(records, max(_shards_of(usage) / WINDOW_S, records / RECORDS_A_CALL))


def _shards_of(usage: Usage) -> float:
    sizes = measure(usage.rate_hz, usage.batch_s)
    return _shards(usage.robots * usage.batches_per_s * _units(sizes.telemetry_item, _WRITE))


def _live_lines_per_s(usage: Usage) -> float:
    """Of the whole fleet: each environment of Lambda 1 gathers what it counts."""
    messages = usage.robots * usage.live_hz
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / _GATHER_S, messages / _MOST_VALUES))


def _units(size: int, unit: int) -> int:
    return max(1, ceil(size / unit))


def _shards(writes_per_s: float) -> int:
    return max(1, ceil(writes_per_s / _PARTITION_WRITES))


def _rule_items(lane: str, messages: float, size: int) -> list[Item]:
    """Of Basic Ingest, which has no messaging charge."""
    metered = messages * _units(size, _METER)
    return [
        Item("IoT Core", lane, "rules triggered", "rule", metered),
        Item("IoT Core", lane, "actions", "action", metered),
    ]


def _ping_items(pings: float, sizes: Sizes, *, all_lines: bool) -> list[Item]:
    """Of each path: the ping in and the pong out; two of three pass a rule, one a function."""
    if not pings:
        return []
    return [
        Item("IoT Core", "ping", "pings and pongs", "message", 6 * pings * _units(sizes.ping, _METER)),
        Item("IoT Core", "ping", "rules triggered", "rule", 2 * pings),
        Item("IoT Core", "ping", "actions", "action", 2 * pings),
        *_lambda_items(
            "ping",
            "echo",
            pings,
            memory_mb=256,
            billed_ms=5.0,
            logged=pings * _PONG_LINE,
            all_lines=all_lines,
        ),
    ]


def _storage(lane: str, what: str, count: float, size: int, usage: Usage) -> Item:
    gigabyte_months = count * (size + _ITEM_OVERHEAD) / 1e9 * usage.retention_days / MONTH_DAYS
    return Item("DynamoDB", lane, what, "storage", gigabyte_months)


def _lambda_items(
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
        logged += calls * len(_PLATFORM_LINES)
    return [
        Item("Lambda", lane, f"{name} invoked", "invocation", calls),
        Item("Lambda", lane, f"{name} computing", compute, calls * memory_mb / 1024 * billed_ms / 1000),
        Item("CloudWatch", lane, f"{name} logging", "logs", logged / 1e9),
    ]


def dollars_per_month(items: list[Item], usage: Usage) -> float:
    """Of the whole fleet."""
    return total(items) * usage.robot_hours_per_month
