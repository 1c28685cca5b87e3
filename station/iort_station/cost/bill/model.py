"""The cost model: each billed unit of a fleet times its list price. Pure.

`bill` computes the line items for a `Usage`. `thesis_bill` computes them for the same driving in the layout
of the thesis that this project started from: each sample is one message, two items and one push.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import ceil
from typing import Any

from iort_contract.catalog.questions import QUESTIONS
from iort_contract.cloud import IOT, PUBNUB
from iort_station.cost.bill import analysing, archiving
from iort_station.cost.bill.line_items import (
    METER,
    PUBNUB_UNIT,
    READ,
    WRITE,
    LineItem,
    function,
    priced,
    rules,
    storage,
    units,
)
from iort_station.cost.prices import PRICES, PUBNUB_MAU_PLANS, Price
from iort_station.cost.sizes import OWN_ITEM_BYTES, Sizes, sizes_of
from iort_station.cost.usage import Usage

# A shard of a stream is a partition of the table. Lambda 2 is invoked once a window, or once these records
# are there; a test compares both with the stack. The thesis had no window: Lambda polls a shard 4 times a
# second.
_PARTITION_WRITES = 1000.0
WINDOW_S, RECORDS_A_CALL = 2.0, 500
_THESIS_POLLS_PER_S, _THESIS_RECORDS_A_CALL = 4.0, 100
# Bytes that the functions log in embedded metric format; a test compares them with functions/. Lambda 1
# gathers its metrics: each environment logs a line in `_GATHER_S`, or sooner with a hundred values of one
# metric; it has four values a message.
_GATHER_S, _MOST_VALUES, _LIVE_LINE, _LIVE_VALUES = 10.0, 100.0, 480, 24
# Lambda 2 logs one line about itself, and one about each stream of its event.
_SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE, _PRESENCE_LINE = 310, 300, 220, 230
# A robot subscribes, with one filter a packet, to four answers of its shadow, three of its pings, its
# viewers and commands. Then it fetches its shadow of less than 1 KB: a request, and an answer that it
# acknowledges.
SUBSCRIPTIONS = 9
_SHADOW_MESSAGES = 3
# `iort send` publishes, the robot receives and acknowledges.
_COMMAND_MESSAGES = 3
# The robot publishes; the function publishes, the robot receives and acknowledges. The function counts in the
# robot's row and reads the newest drives' parameters, of some 1 KB each. The time is a calibration's.
_QUESTION_MESSAGES, _QUESTION_MS, _QUESTION_READS, _ANSWER_LINE = 4, 30.0, 13, 260
# The broker publishes when a connection begins and when it ends.
_PRESENCE_EVENTS, _PRESENCE_MB, _PRESENCE_MS = 2, 256, 20.0


def bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[LineItem]:
    """AWS' line items for a robot-hour; PubNub's are in `pubnub_bill`."""
    return priced(_bill(usage), prices)


def _bill(usage: Usage) -> list[LineItem]:
    usage.check()
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    hour = 3600.0
    batches, own = usage.batches_per_s * hour, usage.own_batches_per_s * hour
    own_item = OWN_ITEM_BYTES
    items = _connecting(usage)
    items += rules("record", batches, sizes.record)
    items += rules("agent, rtt", own, own_item)
    live = usage.live_per_s * hour
    by_pubnub = live if usage.live_transport == PUBNUB else 0.0
    items += rules("live", by_pubnub, sizes.live)
    # Some pass the broker, which evaluates two more rules for each.
    passing = usage.live_at_broker_per_s * hour * units(sizes.live, METER)
    leases = usage.leases_per_s * hour
    items += [
        LineItem("IoT Core", "live", "leases, sent and received", "message", 2 * leases),
        LineItem("IoT Core", "live", "messages", "message", passing),
        LineItem("IoT Core", "live", "rules fault and battery", "rule", 2 * passing),
        LineItem("IoT Core", "live", "their actions, at least one billed", "action", 2 * passing),
    ]
    if usage.live_transport == IOT:
        looking = usage.watched * usage.viewers
        items += [
            LineItem("IoT Core", "live", "received by viewers", "message", passing * usage.viewers),
            LineItem("IoT Core", "live", "viewers' minutes", "connection", 60 * looking / usage.robots),
        ]
    clock = usage.clock_pings_per_s * hour
    commands = usage.command_hz * hour
    items += [
        LineItem(
            "IoT Core", "commands", "sent, received, acknowledged", "message", _COMMAND_MESSAGES * commands
        ),
        LineItem("IoT Core", "ping", "clock pings and pongs", "message", 2 * clock),
        LineItem("IoT Core", "ping", "clock ping rule", "rule", clock),
        LineItem("IoT Core", "ping", "action", "action", clock),
    ]
    items += _question_items(usage)
    items += _ping_items(usage, sizes)
    writes = batches * units(sizes.telemetry_item, WRITE)
    # The batches of one stream in an event; one query reads them and those of the second before.
    of_stream = usage.stream_batches_per_s
    found = max(1.0, of_stream * _shards_of(usage) / summarize_calls_per_s(usage))
    read = found + max(1.0, of_stream)
    reads = batches / found * units(ceil(read) * sizes.telemetry_item, READ)
    # A second whose batches arrive in two events is written twice.
    writes_s = batches * min(1.0, 1 / of_stream + (of_stream > 1) / found)
    items += [
        LineItem("DynamoDB", "record", "telemetry written", "write", writes),
        LineItem("DynamoDB", "agent, rtt", "telemetry written", "write", own * units(own_item, WRITE)),
        LineItem(
            "DynamoDB", "record", "summary written", "write", writes_s * units(sizes.summary_item, WRITE)
        ),
        LineItem("DynamoDB", "agent, rtt", "summary written", "write", own),
        LineItem("DynamoDB", "record", "batches read by Lambda 2", "read", reads),
        LineItem("DynamoDB", "agent, rtt", "batches read by Lambda 2", "read", own),
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
    items += function(
        "record",
        "Lambda 2",
        calls,
        usage,
        memory_mb=usage.summarize_memory_mb,
        billed_ms=usage.summarize_ms + usage.summarize_batch_ms * (batches + own) / calls,
        logged=calls * _SUMMARIZE_LINE + (batches / found + own) * _HEALTH_LINE,
    )
    items += function(
        "live",
        "Lambda 1",
        by_pubnub,
        usage,
        memory_mb=usage.live_memory_mb,
        billed_ms=usage.live_ms,
        logged=_live_lines_per_s(usage) * hour / usage.robots * _LIVE_LINE + by_pubnub * _LIVE_VALUES,
    )
    return [*items, *archiving.items(usage), *analysing.items(usage)]


def thesis_bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[LineItem]:
    """AWS' line items for the same driving in the thesis' layout.

    Each sample is a message through the broker, triggers two rules, is stored in two tables, and invokes
    Lambda 1. Functions have 128 MB on x86. Prices, retention and billed milliseconds are the same as ours.
    The layout has no pings, no metrics of the agent, and no alarms.
    """
    usage = replace(usage, function_logs="all").check()
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    samples = usage.samples_per_s * 3600
    per_s = usage.robots * usage.samples_per_s
    polls = max(_THESIS_POLLS_PER_S * _shards(per_s), per_s / _THESIS_RECORDS_A_CALL)
    calls = min(per_s, polls) * 3600 / usage.robots
    written = samples * units(sizes.sample_item, WRITE)
    functions: dict[str, Any] = {"memory_mb": 128, "logged": 0.0, "compute": "compute_x86"}
    live = function("live", "Lambda 1", samples, usage, billed_ms=usage.live_ms, **functions)
    second = function("record", "Lambda 2", calls, usage, billed_ms=usage.summarize_ms, **functions)
    items = [
        LineItem("IoT Core", "connection", "minutes", "connection", 60),
        LineItem("IoT Core", "connection", "CONNECT", "message", usage.connects_per_hour),
        LineItem("IoT Core", "record", "messages", "message", samples * units(sizes.sample, METER)),
        LineItem("IoT Core", "record", "rule to the table", "rule", samples),
        LineItem("IoT Core", "record", "action", "action", samples),
        LineItem("IoT Core", "live", "rule to Lambda 1", "rule", samples),
        LineItem("IoT Core", "live", "action", "action", samples),
        LineItem("DynamoDB", "record", "first table written", "write", written),
        LineItem("DynamoDB", "record", "second table written", "write", written),
        storage("record", "both tables kept", 2 * samples, sizes.sample_item, usage),
        *second,
        *live,
    ]
    return priced(items, prices)


def pubnub_bill(
    usage: Usage, prices: Mapping[str, Price] = PRICES, *, thesis: bool = False
) -> list[LineItem]:
    """PubNub's line items for a robot-hour on its plan by transactions."""
    usage.check()
    size = sizes_of(usage.rate_hz, usage.batch_s).update
    by_pubnub = usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    messages = (usage.samples_per_s if thesis else by_pubnub) * 3600 * units(size, PUBNUB_UNIT)
    items = [
        LineItem("PubNub", "live", "published", "pubnub_publish", messages),
        LineItem("PubNub", "live", "received by viewers", "pubnub_receive", messages * usage.viewers),
    ]
    return priced(items, prices)


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """The price of PubNub's plan by monthly active users (viewers and Lambda 1); None above the listed
    plans."""
    if usage.live_transport != PUBNUB:
        return 0.0
    users = usage.viewers + 1
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if users <= most), None)


def summarize_calls_per_s(usage: Usage) -> float:
    """Invocations of Lambda 2 a second for the whole fleet: one per window and shard, or one per 500 records
    if that is more."""
    records = usage.robots * (usage.batches_per_s + usage.own_batches_per_s)
    return min(records, max(_shards_of(usage) / WINDOW_S, records / RECORDS_A_CALL))


def _shards_of(usage: Usage) -> float:
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    return _shards(usage.robots * usage.batches_per_s * units(sizes.telemetry_item, WRITE))


def _live_lines_per_s(usage: Usage) -> float:
    """Log lines a second of the whole fleet: each environment of Lambda 1 gathers its metrics."""
    messages = usage.robots * usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / _GATHER_S, messages / _MOST_VALUES))


def _shards(writes_per_s: float) -> int:
    return max(1, ceil(writes_per_s / _PARTITION_WRITES))


def _connecting(usage: Usage) -> list[LineItem]:
    """The connection's minutes, and the messages of each connect.

    AWS meters CONNECT, SUBSCRIBE and a device's PUBACK, but neither the broker's answers nor keep-alives.
    """
    lane, connects = "connection", usage.connects_per_hour
    events = _PRESENCE_EVENTS * connects
    return [
        LineItem("IoT Core", lane, "minutes", "connection", 60),
        LineItem("IoT Core", lane, "CONNECT and SUBSCRIBE", "message", connects * (1 + SUBSCRIPTIONS)),
        LineItem(
            "IoT Core",
            lane,
            "shadow request, answer and PUBACK",
            "message",
            connects * _SHADOW_MESSAGES,
        ),
        LineItem("IoT Core", lane, "the shadow read", "shadow", connects),
        *rules(lane, events, 0),
        *function(
            lane,
            "presence",
            events,
            usage,
            memory_mb=_PRESENCE_MB,
            billed_ms=_PRESENCE_MS,
            logged=events * _PRESENCE_LINE,
        ),
        LineItem("DynamoDB", lane, "robot's row written", "write", events),
    ]


def _question_items(usage: Usage) -> list[LineItem]:
    """Questions that fit into a message, with their answers."""
    asked = usage.questions_per_hour
    if not asked:
        return []
    lane = "questions"
    return [
        LineItem("IoT Core", lane, "questions and answers", "message", _QUESTION_MESSAGES * asked),
        LineItem("IoT Core", lane, "rule triggered", "rule", asked),
        LineItem("IoT Core", lane, "action", "action", asked),
        *function(
            lane,
            "answer",
            asked,
            usage,
            memory_mb=max(question.memory_mb for question in QUESTIONS.values()),
            billed_ms=_QUESTION_MS,
            logged=asked * _ANSWER_LINE,
        ),
        LineItem("DynamoDB", lane, "counted in the robot's row", "write", asked),
        LineItem("DynamoDB", lane, "parameters read", "read", asked * _QUESTION_READS),
    ]


def _ping_items(usage: Usage, sizes: Sizes) -> list[LineItem]:
    """Ping and pong on each path; two of the three paths pass a rule, and one passes a function."""
    pings = usage.ping_hz * 3600
    if not pings:
        return []
    return [
        LineItem("IoT Core", "ping", "pings and pongs", "message", 6 * pings * units(sizes.ping, METER)),
        LineItem("IoT Core", "ping", "rules triggered", "rule", 2 * pings),
        LineItem("IoT Core", "ping", "actions", "action", 2 * pings),
        *function(
            "ping",
            "echo",
            pings,
            usage,
            memory_mb=256,
            billed_ms=5.0,
            logged=pings * _PONG_LINE,
        ),
    ]
