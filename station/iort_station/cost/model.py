"""What a fleet costs: every unit that is billed, from the configuration, times its list price. Pure.

A `Usage` says how robots are driven, `bill` what that comes to item by item, and `thesis_bill` what the
same driving cost in the layout that the project began from: a message, two items and a push a sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from typing import Any

from iort_station.cost.line_items import (
    METER,
    PUBNUB_UNIT,
    READ,
    WRITE,
    Item,
    function,
    priced,
    rules,
    storage,
    units,
)
from iort_station.cost.prices import PRICES, PUBNUB_MAU_PLANS, Price
from iort_station.cost.sizes import OWN_ITEM_BYTES, Sizes, sizes_of
from iort_station.cost.usage import Usage

# A shard of a stream is a partition of the table. Lambda 2 is called once a window, or by as many records;
# a test holds both to the stack. The thesis had no window: Lambda polls a shard four times a second.
_PARTITION_WRITES = 1000.0
WINDOW_S, RECORDS_A_CALL = 2.0, 500
_THESIS_POLLS_PER_S, _THESIS_RECORDS_A_CALL = 4.0, 100
# What functions log in bytes, in embedded metric format; a test holds these to functions/. Lambda 1 gathers
# what it counts: a line an environment in `_GATHER_S`, or sooner with a hundred values of one metric; four a
# message.
_GATHER_S, _MOST_VALUES, _LIVE_LINE, _LIVE_VALUES = 10.0, 100.0, 480, 24
# Lambda 2 writes one about itself, and one about each stream that it was given.
_SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE, _PRESENCE_LINE = 310, 300, 220, 230
# A robot subscribes, a filter a packet, to its shadow's four answers, its pings' three and a command. Once
# connected it fetches the shadow, of less than 1 KB: a question, and an answer that it acknowledges.
SUBSCRIPTIONS = 8
_SHADOW_MESSAGES = 3
# `iort send` publishes, the robot receives and acknowledges.
_COMMAND_MESSAGES = 3
# The broker says of a connection when it began and when it ended.
_PRESENCE_EVENTS, _PRESENCE_MB, _PRESENCE_MS = 2, 256, 20.0


def bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[Item]:
    """What AWS bills a robot-hour, item by item; PubNub apart (`pubnub_bill`)."""
    return priced(_bill(usage), prices)


def _bill(usage: Usage) -> list[Item]:
    usage.check()
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    hour = 3600.0
    batches, own = usage.batches_per_s * hour, usage.own_batches_per_s * hour
    own_item = OWN_ITEM_BYTES
    items = _connecting(usage)
    items += rules("record", batches, sizes.record)
    items += rules("agent, rtt", own, own_item)
    live = usage.live_hz * hour
    items += rules("live", live, sizes.live)
    # Some pass the broker, where two more rules look at them.
    passing = usage.live_at_broker_per_s * hour * units(sizes.live, METER)
    items += [
        Item("IoT Core", "live", "messages", "message", passing),
        Item("IoT Core", "live", "rules fault and battery", "rule", 2 * passing),
        Item("IoT Core", "live", "their actions, or the least billed", "action", 2 * passing),
    ]
    clock = usage.clock_pings_per_s * hour
    commands = usage.command_hz * hour
    items += [
        Item("IoT Core", "commands", "sent, received, acknowledged", "message", _COMMAND_MESSAGES * commands),
        Item("IoT Core", "ping", "the clock's pings and pongs", "message", 2 * clock),
        Item("IoT Core", "ping", "the clock's rule", "rule", clock),
        Item("IoT Core", "ping", "its action", "action", clock),
    ]
    items += _ping_items(usage.ping_hz * hour, sizes, all_lines=usage.function_logs == "all")
    writes = batches * units(sizes.telemetry_item, WRITE)
    # Of one stream in an event: its batches, of which one query reads also the second before.
    of_stream = usage.stream_batches_per_s
    found = max(1.0, of_stream * _shards_of(usage) / summarize_calls_per_s(usage))
    read = found + max(1.0, of_stream)
    reads = batches / found * units(ceil(read) * sizes.telemetry_item, READ)
    # A batch lies in one second; a second whose batches come in two events is written twice.
    writes_s = batches * min(1.0, 1 / of_stream + (of_stream > 1) / found)
    items += [
        Item("DynamoDB", "record", "telemetry written", "write", writes),
        Item("DynamoDB", "agent, rtt", "telemetry written", "write", own * units(own_item, WRITE)),
        Item("DynamoDB", "record", "summary written", "write", writes_s * units(sizes.summary_item, WRITE)),
        Item("DynamoDB", "agent, rtt", "summary written", "write", own),
        Item("DynamoDB", "record", "batches read by Lambda 2", "read", reads),
        Item("DynamoDB", "agent, rtt", "batches read by Lambda 2", "read", own),
    ]
    seconds = min(batches, usage.streams * hour)
    kept = [
        storage("record", "telemetry kept", batches, sizes.telemetry_item, usage),
        storage("record", "summary kept", seconds, sizes.summary_item, usage),
        storage("agent, rtt", "kept", 2 * own, own_item, usage),
    ]
    items += kept
    if usage.recoverable:
        items += [item._replace(what=f"{item.what}, recoverable", price="recovery") for item in kept]
    calls = summarize_calls_per_s(usage) * hour / usage.robots
    all_lines = usage.function_logs == "all"
    items += function(
        "record",
        "Lambda 2",
        calls,
        memory_mb=usage.summarize_memory_mb,
        billed_ms=usage.summarize_ms + usage.summarize_batch_ms * (batches + own) / calls,
        logged=calls * _SUMMARIZE_LINE + (batches / found + own) * _HEALTH_LINE,
        all_lines=all_lines,
    )
    items += function(
        "live",
        "Lambda 1",
        live,
        memory_mb=usage.live_memory_mb,
        billed_ms=usage.live_ms,
        logged=_live_lines_per_s(usage) * hour / usage.robots * _LIVE_LINE + live * _LIVE_VALUES,
        all_lines=all_lines,
    )
    return items


def thesis_bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[Item]:
    """The same driving in the thesis' layout: each sample a message through the broker, which triggers
    two rules, one item in each of two tables, and one invocation of Lambda 1; functions of 128 MB on
    x86. Prices, retention and the milliseconds of an invocation are the same as ours; there are no pings,
    no figures of the agent's own, no alarms and no metrics."""
    usage.check()
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    samples = usage.samples_per_s * 3600
    per_s = usage.robots * usage.samples_per_s
    polls = max(_THESIS_POLLS_PER_S * _shards(per_s), per_s / _THESIS_RECORDS_A_CALL)
    calls = min(per_s, polls) * 3600 / usage.robots
    written = samples * units(sizes.sample_item, WRITE)
    functions: dict[str, Any] = {"memory_mb": 128, "logged": 0.0, "compute": "compute_x86"}
    live = function("live", "Lambda 1", samples, billed_ms=usage.live_ms, **functions)
    second = function("record", "Lambda 2", calls, billed_ms=usage.summarize_ms, **functions)
    items = [
        Item("IoT Core", "connection", "minutes", "connection", 60),
        Item("IoT Core", "connection", "CONNECT", "message", usage.connects_per_hour),
        Item("IoT Core", "record", "messages", "message", samples * units(sizes.sample, METER)),
        Item("IoT Core", "record", "rule to the table", "rule", samples),
        Item("IoT Core", "record", "its action", "action", samples),
        Item("IoT Core", "live", "rule to Lambda 1", "rule", samples),
        Item("IoT Core", "live", "its action", "action", samples),
        Item("DynamoDB", "record", "first table written", "write", written),
        Item("DynamoDB", "record", "second table written", "write", written),
        storage("record", "both tables kept", 2 * samples, sizes.sample_item, usage),
        *second,
        *live,
    ]
    return priced(items, prices)


def pubnub_bill(usage: Usage, prices: Mapping[str, Price] = PRICES, *, thesis: bool = False) -> list[Item]:
    """What PubNub bills a robot-hour on its plan by transactions: a publish each, a receipt a viewer."""
    usage.check()
    size = sizes_of(usage.rate_hz, usage.batch_s).update
    messages = (usage.samples_per_s if thesis else usage.live_hz) * 3600 * units(size, PUBNUB_UNIT)
    items = [
        Item("PubNub", "live", "published", "pubnub_publish", messages),
        Item("PubNub", "live", "received by viewers", "pubnub_receive", messages * usage.viewers),
    ]
    return priced(items, prices)


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """PubNub's plan by monthly active users: the viewers and Lambda 1; None above the listed plans."""
    users = usage.viewers + 1
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if users <= most), None)


def summarize_calls_per_s(usage: Usage) -> float:
    """Invocations of Lambda 2 a second, of the whole fleet: one a window and shard, or as many as events
    of five hundred records need."""
    records = usage.robots * (usage.batches_per_s + usage.own_batches_per_s)
    return min(records, max(_shards_of(usage) / WINDOW_S, records / RECORDS_A_CALL))


def _shards_of(usage: Usage) -> float:
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    return _shards(usage.robots * usage.batches_per_s * units(sizes.telemetry_item, WRITE))


def _live_lines_per_s(usage: Usage) -> float:
    """Of the whole fleet: each environment of Lambda 1 gathers what it counts."""
    messages = usage.robots * usage.live_hz
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / _GATHER_S, messages / _MOST_VALUES))


def _shards(writes_per_s: float) -> int:
    return max(1, ceil(writes_per_s / _PARTITION_WRITES))


def _connecting(usage: Usage) -> list[Item]:
    """The connection, and what each time takes that it is made: AWS meters CONNECT, SUBSCRIBE and a device's
    PUBACK as messages, and not what the broker answers nor keep-alives."""
    lane, connects = "connection", usage.connects_per_hour
    events = _PRESENCE_EVENTS * connects
    return [
        Item("IoT Core", lane, "minutes", "connection", 60),
        Item("IoT Core", lane, "CONNECT and SUBSCRIBE", "message", connects * (1 + SUBSCRIPTIONS)),
        Item(
            "IoT Core",
            lane,
            "the shadow's question, answer and PUBACK",
            "message",
            connects * _SHADOW_MESSAGES,
        ),
        Item("IoT Core", lane, "the shadow read", "shadow", connects),
        *rules(lane, events, 0),
        *function(
            lane,
            "presence",
            events,
            memory_mb=_PRESENCE_MB,
            billed_ms=_PRESENCE_MS,
            logged=events * _PRESENCE_LINE,
            all_lines=usage.function_logs == "all",
        ),
        Item("DynamoDB", lane, "robot's row written", "write", events),
    ]


def _ping_items(pings: float, sizes: Sizes, *, all_lines: bool) -> list[Item]:
    """Of each path: the ping in and the pong out; two of three pass a rule, one a function."""
    if not pings:
        return []
    return [
        Item("IoT Core", "ping", "pings and pongs", "message", 6 * pings * units(sizes.ping, METER)),
        Item("IoT Core", "ping", "rules triggered", "rule", 2 * pings),
        Item("IoT Core", "ping", "actions", "action", 2 * pings),
        *function(
            "ping",
            "echo",
            pings,
            memory_mb=256,
            billed_ms=5.0,
            logged=pings * _PONG_LINE,
            all_lines=all_lines,
        ),
    ]
