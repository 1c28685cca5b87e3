"""The cost model: what each capability takes, in units of the price list, times the prices. Pure.

`bill` has the line items for a `Usage`. `thesis_bill` has them for the same driving in the layout of the
thesis that this project started from: each sample is one message, two items and one push. The rest is a
deployment's own month, a robot-year in the archive, and PubNub.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from math import ceil
from typing import NamedTuple

from iort_contract.catalog.metrics import METRICS, metrics_of
from iort_contract.catalog.questions import QUESTIONS
from iort_contract.cloud import IOT, PUBNUB
from iort_station.cost.prices import MONTH_DAYS, MONTH_HOURS, PRICES, PUBNUB_MAU_PLANS, Price
from iort_station.cost.usage import Usage

METER, WRITE, READ, PUBNUB_UNIT = 5 * 1024, 1024, 4 * 1024, 2048
# "For most use cases, storage is the sum of item sizes, plus 100 bytes an item of indexing overhead."
_ITEM_OVERHEAD = 100
_HOUR_S, _YEAR_DAYS = 3600.0, 365

# --- sizes, as `python -m bench.load.message_sizes` measures them ---------------------------------------


class Measured(NamedTuple):
    """Bytes of a batch's message and item, and of a second's summary, by their number of samples.

    Messages count with their topics, as AWS meters them; items with names and values.
    """

    samples: int
    record: int
    telemetry_item: int
    summary_item: int


# One second with this many samples. In a shorter batch above 50 Hz values change less between samples, so it
# is up to a quarter smaller than in this table.
TABLE = (
    Measured(1, 257, 240, 383),
    Measured(2, 281, 264, 540),
    Measured(5, 337, 320, 557),
    Measured(10, 398, 380, 552),
    Measured(20, 498, 480, 573),
    Measured(50, 734, 716, 589),
    Measured(100, 1043, 1024, 586),
    Measured(200, 1551, 1532, 587),
    Measured(500, 3087, 3068, 580),
    Measured(1000, 5444, 5424, 576),
    Measured(2000, 10368, 10348, 600),
)
# An update for PubNub, the telemetry item of one sample of the agent's metrics, and the thesis' flat JSON
# message and item of one sample.
UPDATE_BYTES, OWN_ITEM_BYTES, SAMPLE_BYTES, SAMPLE_ITEM_BYTES = 480, 236, 356, 277
# The archive's Parquet beside the items that are in it, of an hour that is driven from end to end.
ARCHIVED_SHARE = 0.60


def sizes_of(rate_hz: float, batch_s: float) -> Measured:
    """The sizes for a VESC's stream at this rate, in batches of this length."""
    return _interpolated(rate_hz * batch_s)._replace(summary_item=_interpolated(rate_hz).summary_item)


def _interpolated(samples: float) -> Measured:
    rounded = min(max(1, round(samples)), TABLE[-1].samples)
    i = bisect_left(TABLE, (rounded,))
    above, below = TABLE[i], TABLE[max(0, i - 1)]
    if above.samples == rounded:
        return above
    share = (rounded - below.samples) / (above.samples - below.samples)
    return Measured(*(round(low + share * (high - low)) for low, high in zip(below, above, strict=True)))


def units(size: int, unit: int) -> int:
    """The number of billed units of this size."""
    return max(1, ceil(size / unit))


# --- what the capabilities take -------------------------------------------------------------------------

# Units of a robot-hour by the price's name.
Table = dict[str, float]
# A shard of a stream is a partition of the table. Lambda 2 is invoked once a window, or once these records
# are there; a test compares both with the stack. The thesis had no window: Lambda polls a shard 4 times a
# second.
_PARTITION_WRITES = 1000.0
WINDOW_S, RECORDS_A_CALL = 2.0, 500
_THESIS_POLLS_PER_S, _THESIS_RECORDS_A_CALL = 4.0, 100
# Billed milliseconds of Lambda 2 for each batch in an event, which only AWS knows.
_SUMMARIZE_BATCH_MS = 5.0
# Bytes that the functions log in embedded metric format; a test compares them with functions/. Lambda 1
# gathers its metrics: each environment logs a line in `_GATHER_S`, or sooner with a hundred values of one
# metric; it has four values a message. Lambda 2 logs a line about itself, and one about each stream.
_GATHER_S, _MOST_VALUES, _LIVE_VALUES = 10.0, 100.0, 24
_LIVE_LINE, _SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE, _PRESENCE_LINE = 480, 310, 300, 220, 230
_ANSWER_LINE, _ARCHIVE_LINE, _ANALYSIS_LINE = 260, 330, 260
# Lambda's own log lines for an invocation.
_REQUEST = "8f507cfc-xmpl-4697-b07a-ac58fc914c95"
PLATFORM_LINES = (
    f"START RequestId: {_REQUEST} Version: $LATEST\n"
    f"END RequestId: {_REQUEST}\n"
    f"REPORT RequestId: {_REQUEST}\tDuration: 12.34 ms\tBilled Duration: 13 ms\t"
    "Memory Size: 256 MB\tMax Memory Used: 81 MB\t\n"
)
# A robot subscribes, with one filter a packet, to four answers of its shadow, three of its pings, its
# viewers and commands. Then it fetches its shadow of less than 1 KB: a request, and an answer that it
# acknowledges. AWS meters CONNECT, SUBSCRIBE and a device's PUBACK, not the broker's answers or keep-alives.
SUBSCRIPTIONS, _SHADOW_MESSAGES = 9, 3
# `iort send` publishes, the robot receives and acknowledges. Of a question the robot publishes; the function
# publishes, the robot receives and acknowledges. The function reads the newest drives' parameters, of some
# 1 KB each; its time is a calibration's.
_COMMAND_MESSAGES, _QUESTION_MESSAGES, _QUESTION_MS, _QUESTION_READS = 3, 4, 30.0, 13
# The archive, as stacks/archive.py and stacks/storage.py deploy it; a test compares them. Billed seconds of
# an hour or a day, of 180,000 samples in it (2.2 s of processor, as measured), and of a run that only plans;
# the first and the last are assumptions.
ARCHIVE_MB, _ARCHIVE_RUNS_A_DAY, STANDARD_DAYS = 1769, 25, 30
_RUN_S, _ARCHIVED_SAMPLE_S, _PLAN_S = 0.8, 2.2 / 180_000, 0.2
# A class other than Standard bills, and the lifecycle moves, no object below this.
_LEAST_MOVED = 128 * 1024
# Hour and day have a note each, written and removed; the hour has a row, which the day writes once more, in a
# transaction of twice the price. A task is sent, received and deleted.
_ARCHIVE_WRITES, _ARCHIVE_ROW_READS, _TASK_REQUESTS = 2 + 2 + 1 + 2, 4, 3
# Each night the hours that expire within this share of the retention, at most so many days, are looked for.
_SOUGHT_SHARE, _SOUGHT_DAYS = 0.2, 14
# The function that analyses a drive, as stacks/analysis.py deploys it: it has a whole processor, and so many
# run at once, each an express workflow. A drive takes seconds, units and objects for reading and writing.
ANALYSIS_MB, DRIVES_AT_ONCE, DRIVE_OBJECTS = 1769, 40, 5
_WORKFLOW_MB, _DRIVE_S, _DRIVE_WRITES = 64, 1.0, 4
# A robot-hour with 180,000 samples took 1.6 s of this project's test machine, as `make bench ONLY=analysis`
# measures it; its results were 0.5 MB, which are kept, here counted for a year.
_ANALYSED_SAMPLE_S, _RESULT_BYTES, _RESULT_MONTHS = 1.6 / 180_000, 5e5 / 180_000, 12
# States of a run, besides one for each robot and one for each drive; three of them call a function. Both days
# are looked at every night, and rows of earlier drives are compared, a read unit each.
_STATES, _CALLS, _PLANNED_DAYS, _COMPARED_ROWS = 5, 3, 2, 320


def _function(usage: Usage, calls: float, memory_mb: int, billed_ms: float, logged: float) -> Table:
    """A function's invocations; ``logged`` counts the bytes of its own log lines in an hour."""
    logged += calls * len(PLATFORM_LINES) * (usage.function_logs == "all")
    gb_s = calls * memory_mb / 1024 * billed_ms / 1000
    return {"invocation": calls, "compute_arm": gb_s, "logs": logged / 1e9}


def _kept(usage: Usage, *items: tuple[float, int]) -> Table:
    """The storage of items in gigabyte-months: how many an hour, and of what size."""
    stored = sum(count * (size + _ITEM_OVERHEAD) for count, size in items)
    gb_months = stored / 1e9 * usage.retention_days / MONTH_DAYS
    return {"storage": gb_months, **({"recovery": gb_months} if usage.recoverable else {})}


def _connection(usage: Usage) -> Table:
    connects = usage.connects_per_hour
    # The broker publishes when a connection begins and when it ends: presence.
    events = 2 * connects
    return {
        "connection": 60,
        "message": connects * (1 + SUBSCRIPTIONS + _SHADOW_MESSAGES),
        "shadow": connects,
        **dict.fromkeys(("rule", "action", "write"), events),
        **_function(usage, events, 256, 20.0, events * _PRESENCE_LINE),
    }


def _record(usage: Usage) -> Table:
    """By Basic Ingest, which has no messaging charge; then telemetry and summary."""
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    batches, own = usage.batches_per_s * _HOUR_S, usage.own_batches_per_s * _HOUR_S
    metered = batches * units(sizes.record, METER)
    # The batches of one stream in an event; one query reads them and those of the second before.
    of_stream, calls_per_s = usage.stream_batches_per_s, summarize_calls_per_s(usage)
    together = max(1.0, of_stream * _shards_of(usage) / calls_per_s)
    read = ceil(together + max(1.0, of_stream)) * sizes.telemetry_item
    # A second whose batches arrive in two events is written twice.
    seconds_written = batches * min(1.0, 1 / of_stream + (of_stream > 1) / together)
    seconds = min(batches, usage.streams * _HOUR_S)
    written = batches * units(sizes.telemetry_item, WRITE) + seconds_written * units(
        sizes.summary_item, WRITE
    )
    calls = calls_per_s * _HOUR_S / usage.robots
    logged = calls * _SUMMARIZE_LINE + (batches / together + own) * _HEALTH_LINE
    ms = usage.summarize_ms + _SUMMARIZE_BATCH_MS * (batches + own) / calls
    return {
        **dict.fromkeys(("rule", "action"), metered),
        "write": written,
        "read": batches / together * units(read, READ),
        **_kept(usage, (batches, sizes.telemetry_item), (seconds, sizes.summary_item)),
        **_function(usage, calls, usage.summarize_memory_mb, ms, logged),
    }


def _own(usage: Usage) -> Table:
    """The agent's own streams, of a sample a batch; Lambda 2's calls are counted with the others."""
    own = usage.own_batches_per_s * _HOUR_S
    return {
        **dict.fromkeys(("rule", "action", "read"), own),
        "write": 2 * own,
        **_kept(usage, (2 * own, OWN_ITEM_BYTES)),
    }


def _live(usage: Usage) -> Table:
    by_pubnub = usage.live_per_s * _HOUR_S if usage.live_transport == PUBNUB else 0.0
    logged = live_lines_per_s(usage) * _HOUR_S / usage.robots * _LIVE_LINE + by_pubnub * _LIVE_VALUES
    # By AWS IoT each viewer is connected while somebody looks, and receives each message then.
    receivers = usage.watched * (usage.viewers if usage.live_transport == IOT else 0)
    passing, leases = usage.live_at_broker_per_s * _HOUR_S, usage.leases_per_s * _HOUR_S
    return {
        # A lease is sent and received.
        "message": 2 * leases + passing + receivers * usage.live_hz * _HOUR_S,
        # Two more rules, for faults and a low battery, evaluate each that passes the broker.
        **dict.fromkeys(("rule", "action"), 2 * passing + by_pubnub),
        "connection": 60 * receivers / usage.robots,
        **_function(usage, by_pubnub, usage.live_memory_mb, usage.live_ms, logged),
    }


def _commands(usage: Usage) -> Table:
    return {"message": _COMMAND_MESSAGES * usage.command_hz * _HOUR_S}


def _questions(usage: Usage) -> Table:
    """Questions that fit into a message, with their answers; each is counted in the robot's row."""
    questions = usage.questions_per_hour
    memory_mb = max(question.memory_mb for question in QUESTIONS.values())
    return {
        "message": _QUESTION_MESSAGES * questions,
        **dict.fromkeys(("rule", "action", "write"), questions),
        "read": questions * _QUESTION_READS,
        **_function(usage, questions, memory_mb, _QUESTION_MS, questions * _ANSWER_LINE),
    }


def _ping(usage: Usage) -> Table:
    """Ping and pong on each path; two of the three paths pass a rule, and one passes a function."""
    clock, pings = usage.clock_pings_per_s * _HOUR_S, usage.ping_hz * _HOUR_S
    return {
        "message": 2 * clock + 6 * pings,
        **dict.fromkeys(("rule", "action"), clock + 2 * pings),
        **_function(usage, pings, 256, 5.0, pings * _PONG_LINE),
    }


class Recorded(NamedTuple):
    """What a robot records in an hour: bytes in the table with AWS' overhead, read units, and bytes in the
    archive, those that go to a cheaper class after a month and those in objects too small for it."""

    table: float
    reads: float
    moved: float
    small: float


def recorded(usage: Usage) -> Recorded:
    """An hour of all streams."""
    item = sizes_of(usage.rate_hz, usage.batch_s).telemetry_item
    batches, own = usage.batches_per_s * _HOUR_S, usage.own_batches_per_s * _HOUR_S
    archived, own_archived = batches * item * ARCHIVED_SHARE, own * OWN_ITEM_BYTES * ARCHIVED_SHARE
    is_moved = archived / usage.streams * usage.hours_per_day >= _LEAST_MOVED
    return Recorded(
        table=batches * (item + _ITEM_OVERHEAD) + own * (OWN_ITEM_BYTES + _ITEM_OVERHEAD),
        reads=(batches * item + own * OWN_ITEM_BYTES) / READ,
        moved=archived * is_moved,
        small=own_archived + archived * (not is_moved),
    )


def _archive(usage: Usage) -> Table:
    """What docs/reference/archive.md tells, kept for ``archive_days``. Deleting objects is free."""
    if not usage.archive_days:
        return {}
    hour, days = recorded(usage), usage.archive_days
    standard, rarer = min(days, STANDARD_DAYS) / MONTH_DAYS, max(0, days - STANDARD_DAYS) / MONTH_DAYS
    in_standard = hour.moved * standard + hour.small * (standard + rarer)
    kept = {"s3_standard": in_standard / 1e9, "s3_instant": hour.moved * rarer / 1e9}
    return {**_archiving(usage, hour), **kept}


def _archiving(usage: Usage, hour: Recorded) -> Table:
    streams, days = usage.streams + usage.own_streams, 1 / usage.hours_per_day
    # The schedules are the deployment's; each robot has its share.
    runs = _ARCHIVE_RUNS_A_DAY * days / usage.robots
    # An hour and a day of each stream, and each night its search.
    written, searches = streams * (1 + days), streams * days
    calls = written + searches + runs
    computing_s = _RUN_S * written + _PLAN_S * (searches + runs)
    computing_s += _ARCHIVED_SAMPLE_S * _HOUR_S * usage.samples_per_s
    sought = min(_SOUGHT_DAYS, usage.retention_days * _SOUGHT_SHARE)
    return {
        # Items are read, and counted before they expire: DynamoDB bills a count as a read.
        "read": 2 * hour.reads + streams * (_ARCHIVE_ROW_READS + sought),
        "write": streams * _ARCHIVE_WRITES,
        "schedule": runs,
        "queue_request": _TASK_REQUESTS * (written + searches),
        # An hour's object is written and read once; the day's is written, and moved if it is not too small.
        "s3_put": streams * (1 + days),
        "s3_get": streams * (4 + days),
        "s3_move": usage.streams * days * bool(hour.moved),
        **_function(usage, calls, ARCHIVE_MB, 1000 * computing_s / calls, _ARCHIVE_LINE * calls),
    }


def drive_billed_s(cpu_s: float) -> float:
    """Billed seconds of a drive whose analysis takes a whole processor ``cpu_s``, as its function has."""
    return cpu_s + _DRIVE_S


def drive_items(usage: Usage, drives: float, billed_s: float) -> list[LineItem]:
    """The line items of ``drives`` in a robot-hour, each of ``billed_s`` seconds."""
    return _priced({"analysis": _drives(usage, drives, billed_s)}, PRICES)


def _drives(usage: Usage, drives: float, billed_s: float) -> Table:
    # The functions read strongly consistent; the stream that tells of motion is read to find the drives.
    streams_read = usage.batches_per_s + _PLANNED_DAYS * usage.stream_batches_per_s
    return {
        "compute_arm": drives * billed_s * ANALYSIS_MB / 1024,
        **dict.fromkeys(("invocation", "transition", "express_request", "s3_get"), drives),
        "express_duration": drives * billed_s * _WORKFLOW_MB / 1024,
        "read": streams_read * _HOUR_S * sizes_of(usage.rate_hz, usage.batch_s).telemetry_item / READ,
        "write": drives * _DRIVE_WRITES,
        "s3_put": drives * DRIVE_OBJECTS,
    }


def _analysis(usage: Usage) -> Table:
    """Drives that are analysed in the next night."""
    if not usage.drive_minutes:
        return {}
    drives = 60 / usage.drive_minutes
    cpu_s = _ANALYSED_SAMPLE_S * usage.samples_per_s * 60 * usage.drive_minutes
    # A night of a robot, and its share of the run.
    nights = 1 / usage.hours_per_day
    runs = nights / usage.robots
    calls = nights + _CALLS * runs
    logged = _ANALYSIS_LINE * (drives + calls)
    logged += drives * len(PLATFORM_LINES) * (usage.function_logs == "all")
    night = {
        **_function(usage, calls, ANALYSIS_MB, 1000 * _DRIVE_S, logged),
        "read": nights * _COMPARED_ROWS,
        "s3_put": nights,
        "transition": nights + _STATES * runs,
        "s3_standard": _RESULT_BYTES * _HOUR_S * usage.samples_per_s / 1e9 * _RESULT_MONTHS,
        "schedule": runs,
    }
    of_drives = _drives(usage, drives, drive_billed_s(cpu_s))
    return {name: night.get(name, 0.0) + of_drives.get(name, 0.0) for name in night | of_drives}


# The lanes of a bill.
CAPABILITIES: dict[str, Callable[[Usage], Table]] = {
    "connection": _connection,
    "record": _record,
    "agent, rtt": _own,
    "live": _live,
    "commands": _commands,
    "ping": _ping,
    "questions": _questions,
    "archive": _archive,
    "analysis": _analysis,
}


def summarize_calls_per_s(usage: Usage) -> float:
    """Invocations of Lambda 2 a second for the whole fleet: one per window and shard, or one per 500 records
    if that is more."""
    records = usage.robots * (usage.batches_per_s + usage.own_batches_per_s)
    return min(records, max(_shards_of(usage) / WINDOW_S, records / RECORDS_A_CALL))


def _shards_of(usage: Usage) -> int:
    item = sizes_of(usage.rate_hz, usage.batch_s).telemetry_item
    return _shards(usage.robots * usage.batches_per_s * units(item, WRITE))


def _shards(writes_per_s: float) -> int:
    return max(1, ceil(writes_per_s / _PARTITION_WRITES))


def live_lines_per_s(usage: Usage) -> float:
    """Log lines a second of the whole fleet: each environment of Lambda 1 gathers its metrics."""
    messages = usage.robots * usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / _GATHER_S, messages / _MOST_VALUES))


# --- bills ----------------------------------------------------------------------------------------------


class LineItem(NamedTuple):
    """One line of a bill: ``units`` per robot-hour at the price named ``price`` in `PRICES`."""

    lane: str
    price: str
    units: float
    # Dollars per unit; None means the built-in list price.
    each: float | None = None

    @property
    def service(self) -> str:
        return PRICES[self.price].service

    @property
    def what(self) -> str:
        return PRICES[self.price].unit

    @property
    def dollars(self) -> float:
        """Dollars per robot-hour."""
        return self.units * (PRICES[self.price].each if self.each is None else self.each)


def _priced(lanes: Mapping[str, Table], prices: Mapping[str, Price]) -> list[LineItem]:
    return [
        LineItem(lane, price, count, prices[price].each)
        for lane, table in lanes.items()
        for price, count in table.items()
    ]


def bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[LineItem]:
    """AWS' line items for a robot-hour; PubNub's are in `pubnub_bill`."""
    usage.check()
    return _priced({lane: table(usage) for lane, table in CAPABILITIES.items()}, prices)


def total(items: Iterable[LineItem]) -> float:
    """Dollars per robot-hour."""
    return sum(item.dollars for item in items)


def dollars_per_month(items: Iterable[LineItem], usage: Usage) -> float:
    """Dollars per month for the whole fleet."""
    return total(items) * usage.robot_hours_per_month


def thesis_bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[LineItem]:
    """AWS' line items for the same driving in the thesis' layout.

    Each sample is a message through the broker, triggers two rules, is stored in two tables, and invokes
    Lambda 1. Functions have 128 MB on x86. Prices, retention and billed milliseconds are the same as ours.
    The layout has no pings, no metrics of the agent, and no alarms.
    """
    usage = replace(usage, function_logs="all", recoverable=False).check()
    samples, per_s = usage.samples_per_s * _HOUR_S, usage.robots * usage.samples_per_s
    polls = max(_THESIS_POLLS_PER_S * _shards(per_s), per_s / _THESIS_RECORDS_A_CALL)
    calls = min(per_s, polls) * _HOUR_S / usage.robots

    def function(calls: float, billed_ms: float) -> Table:
        table = _function(usage, calls, 128, billed_ms, 0.0)
        table["compute_x86"] = table.pop("compute_arm")
        return table

    lanes = {
        "connection": {"connection": 60, "message": usage.connects_per_hour},
        "record": {
            "message": samples * units(SAMPLE_BYTES, METER),
            **dict.fromkeys(("rule", "action"), samples),
            # Of both tables.
            "write": 2 * samples * units(SAMPLE_ITEM_BYTES, WRITE),
            **_kept(usage, (2 * samples, SAMPLE_ITEM_BYTES)),
            **function(calls, usage.summarize_ms),
        },
        "live": {**dict.fromkeys(("rule", "action"), samples), **function(samples, usage.live_ms)},
    }
    return _priced(lanes, prices)


def pubnub_bill(
    usage: Usage, prices: Mapping[str, Price] = PRICES, *, thesis: bool = False
) -> list[LineItem]:
    """PubNub's line items for a robot-hour on its plan by transactions."""
    usage.check()
    by_pubnub = usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    messages = (usage.samples_per_s if thesis else by_pubnub) * _HOUR_S * units(UPDATE_BYTES, PUBNUB_UNIT)
    table = {"pubnub_publish": messages, "pubnub_receive": messages * usage.viewers}
    return _priced({"live": table}, prices)


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """The price of PubNub's plan by monthly active users (viewers and Lambda 1); None above the listed
    plans."""
    if usage.live_transport != PUBNUB:
        return 0.0
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if usage.viewers + 1 <= most), None)


class Place(NamedTuple):
    """Where a robot-year is kept: its bytes there, and dollars; a month, or once."""

    what: str
    size_bytes: float
    dollars: float


def robot_year(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[Place]:
    """What a robot records in a year, in DynamoDB and in the archive."""
    hours = usage.hours_per_day * _YEAR_DAYS
    hour = recorded(usage)
    table, _, moved, small = (hours * each for each in hour)
    archived = moved + small
    each = {name: price.each for name, price in prices.items()}
    making = hours * total(_priced({"archive": _archiving(usage, hour)}, prices))
    later = moved * each["s3_instant"] + small * each["s3_standard"]
    first = f"in the archive, a month of the first {STANDARD_DAYS} days"
    again = f"read as a whole after {STANDARD_DAYS} days, each time"
    return [
        Place("in DynamoDB, a month", table, table / 1e9 * each["storage"]),
        Place(first, archived, archived / 1e9 * each["s3_standard"]),
        Place("in the archive, a month after that", archived, later / 1e9),
        Place("from DynamoDB into the archive, once", archived, making),
        Place(again, archived, moved / 1e9 * each["s3_instant_read"]),
    ]


# --- a deployment's month, whoever drives ---------------------------------------------------------------

# Lambda polls a queue around the clock with five long polls of at most 20 s. It needs only two for a mapping
# without a limit on its concurrency, but all of ours have one: the quarantine's, that of batches put off, and
# the archive's ("Configuring scaling behavior for SQS event source mappings").
_QUEUES, _POLLERS, _POLL_S = 3, 5, 20
# SQS requests the queue's key every five minutes (KmsDataKeyReusePeriodSeconds).
_KEYS_AN_HOUR = 12
# "Amazon CloudWatch pricing", free tier: three dashboards of up to fifty metrics each, ten custom metrics,
# ten alarms that name their metric. A dashboard with more metrics is billed, and so is each metric that a
# Metrics Insights alarm analyses or that GetMetricData returns. It is the whole account's.
FREE_DASHBOARDS, FREE_DASHBOARD_METRICS, FREE_METRICS, FREE_ALARMS = 3, 50, 10, 10
# The live page's refresh interval; CloudWatch's own console is free.
PAGE_REFRESH_S = 30
# With robot_metrics, the searches of the last dashboard find this many metrics per robot.
ROBOT_SEARCHES = 4


def deployment_dollars_per_month(usage: Usage, prices: Mapping[str, Price] = PRICES) -> dict[str, float]:
    """Dollars by purpose: metrics, alarms, dashboards, queue polls, and if set the account's own key.

    Costs below a cent are left out. Parameter Store's standard tier, SNS' mails, the budget and reading a
    table's stream are free; the files of code and page are a few megabytes.
    """
    metrics = len(METRICS) + usage.robots * usage.robot_metrics * len(metrics_of("health"))
    if usage.live_transport == IOT:
        # AWS bills what is written, and nothing calls Lambda 1.
        metrics -= len(metrics_of("live"))
    dashboards = dashboard_metrics(usage)
    small = sum(shown <= FREE_DASHBOARD_METRICS for shown in dashboards)
    # People look at one dashboard at a time; this counts the largest.
    requested = usage.dashboard_hours * 3600 / PAGE_REFRESH_S * max(dashboards, default=0)
    table: dict[str, tuple[str, float]] = {
        "metrics": ("metric", max(0, metrics - FREE_METRICS)),
        "alarms": ("alarm", max(0, usage.alarms - FREE_ALARMS)),
        "alarms by Metrics Insights, at most": ("insights_alarm", usage.insights_metrics),
        "dashboards": ("dashboard", len(dashboards) - min(small, FREE_DASHBOARDS)),
        "metrics requested by the live page": ("metric_request", requested),
        "polling the queues": ("queue_request", _QUEUES * _POLLERS * MONTH_HOURS * 3600 / _POLL_S),
    }
    if usage.customer_key:
        table["key"] = ("key", 1)
        table["requests to the key, by the queue"] = ("key_request", _KEYS_AN_HOUR * MONTH_HOURS)
    return {what: count * prices[price].each for what, (price, count) in table.items()}


def dashboard_metrics(usage: Usage) -> tuple[int, ...]:
    """The number of metrics on each dashboard, including those that a search finds."""
    if not usage.robot_metrics or not usage.dashboards:
        return usage.dashboards
    return (*usage.dashboards[:-1], usage.dashboards[-1] + ROBOT_SEARCHES * usage.robots)
