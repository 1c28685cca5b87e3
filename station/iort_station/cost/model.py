"""The cost model: the usage of each capability, in units of the price list, times the prices. Pure.

`bill` has the line items for a `Usage`. `thesis_bill` has them for the same driving in the layout of the
thesis that this project started from: each sample is one message, two items and one push. The rest is a
deployment's own month, a robot-year in the archive, and PubNub.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
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

# --- sizes, as `python -m bench.load.message_sizes` measures them -------------------------------------

# The telemetry item of one sample of the agent's metrics.
OWN_ITEM_BYTES = 236
# The archive's Parquet beside the items that are in it, of an hour that is driven from end to end.
ARCHIVED_SHARE = 0.60


class Measured(NamedTuple):
    """Bytes of a batch's message and item, and of a second's summary, by their number of samples."""

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


@dataclass(frozen=True)
class Sizes:
    """Bytes of messages with their topics, as AWS meters them, and of items with names and values.

    ``sample`` is one sample as a flat JSON message.
    """

    record: int
    telemetry_item: int
    summary_item: int
    live: int = 402
    ping: int = 71
    update: int = 480
    sample: int = 356
    sample_item: int = 277


def sizes_of(rate_hz: float, batch_s: float) -> Sizes:
    """The sizes for a VESC's stream at this rate, in batches of this length."""
    batch = _interpolated(rate_hz * batch_s)
    return Sizes(batch.record, batch.telemetry_item, _interpolated(rate_hz).summary_item)


def _interpolated(samples: float) -> Measured:
    """The sizes for a number of samples, interpolated between the two nearest rows."""
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

# Units of a robot-hour by the price's name, of what makes them.
Table = dict[str, dict[str, float]]
# A shard of a stream is a partition of the table. Lambda 2 is invoked once a window, or once these records
# are there; a test compares both with the stack. The thesis had no window: Lambda polls a shard 4 times a
# second.
_PARTITION_WRITES = 1000.0
WINDOW_S, RECORDS_A_CALL = 2.0, 500
_THESIS_POLLS_PER_S, _THESIS_RECORDS_A_CALL = 4.0, 100
# Bytes that the functions log in embedded metric format; a test compares them with functions/. Lambda 1
# gathers its metrics: each environment logs a line in `_GATHER_S`, or sooner with a hundred values of one
# metric; it has four values a message. Lambda 2 logs a line about itself, and one about each stream.
_GATHER_S, _MOST_VALUES, _LIVE_LINE, _LIVE_VALUES = 10.0, 100.0, 480, 24
_SUMMARIZE_LINE, _HEALTH_LINE, _PONG_LINE, _PRESENCE_LINE = 310, 300, 220, 230
_ANSWER_LINE, _ARCHIVE_LINE, _ANALYSIS_LINE = 260, 330, 260
# A robot subscribes, with one filter a packet, to four answers of its shadow, three of its pings, its
# viewers and commands. Then it fetches its shadow of less than 1 KB: a request, and an answer that it
# acknowledges. AWS meters CONNECT, SUBSCRIBE and a device's PUBACK, not the broker's answers or keep-alives.
SUBSCRIPTIONS = 9
_SHADOW_MESSAGES = 3
# `iort send` publishes, the robot receives and acknowledges. Of a question the robot publishes; the function
# publishes, the robot receives and acknowledges. The function reads the newest drives' parameters, of some
# 1 KB each; its time is a calibration's.
_COMMAND_MESSAGES, _QUESTION_MESSAGES, _QUESTION_MS, _QUESTION_READS = 3, 4, 30.0, 13
# Lambda's own log lines for an invocation.
_REQUEST = "8f507cfc-xmpl-4697-b07a-ac58fc914c95"
PLATFORM_LINES = (
    f"START RequestId: {_REQUEST} Version: $LATEST\n"
    f"END RequestId: {_REQUEST}\n"
    f"REPORT RequestId: {_REQUEST}\tDuration: 12.34 ms\tBilled Duration: 13 ms\t"
    "Memory Size: 256 MB\tMax Memory Used: 81 MB\t\n"
)
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


def _function(
    usage: Usage,
    calls: float,
    *,
    memory_mb: int,
    billed_ms: float,
    logged: float,
    compute: str = "compute_arm",
) -> dict[str, float]:
    """A function's invocations; ``logged`` counts the bytes of its own log lines in an hour."""
    if usage.function_logs == "all":
        logged += calls * len(PLATFORM_LINES)
    gb_s = calls * memory_mb / 1024 * billed_ms / 1000
    return {"invocation": calls, compute: gb_s, "logs": logged / 1e9}


def _kept(usage: Usage, count: float, size: int) -> dict[str, float]:
    """The storage of ``count`` items an hour, in gigabyte-months."""
    gb_months = count * (size + _ITEM_OVERHEAD) / 1e9 * usage.retention_days / MONTH_DAYS
    return {"storage": gb_months, **({"recovery": gb_months} if usage.recoverable else {})}


def _connection(usage: Usage) -> Table:
    connects = usage.connects_per_hour
    # The broker publishes when a connection begins and when it ends.
    events = 2 * connects
    logged = events * _PRESENCE_LINE
    return {
        "minutes": {"connection": 60},
        "CONNECT and SUBSCRIBE": {"message": connects * (1 + SUBSCRIPTIONS)},
        "shadow request, answer and PUBACK": {"message": connects * _SHADOW_MESSAGES},
        "the shadow read": {"shadow": connects},
        "presence": {
            **dict.fromkeys(("rule", "action", "write"), events),
            **_function(usage, events, memory_mb=256, billed_ms=20.0, logged=logged),
        },
    }


def _record(usage: Usage) -> Table:
    """By Basic Ingest, which has no messaging charge."""
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    batches, own = usage.batches_per_s * _HOUR_S, usage.own_batches_per_s * _HOUR_S
    metered = batches * units(sizes.record, METER)
    # The batches of one stream in an event; one query reads them and those of the second before.
    of_stream = usage.stream_batches_per_s
    together = max(1.0, of_stream * _shards_of(usage) / summarize_calls_per_s(usage))
    read = ceil(together + max(1.0, of_stream)) * sizes.telemetry_item
    # A second whose batches arrive in two events is written twice.
    seconds_written = batches * min(1.0, 1 / of_stream + (of_stream > 1) / together)
    calls = summarize_calls_per_s(usage) * _HOUR_S / usage.robots
    return {
        "batches": {"rule": metered, "action": metered},
        "telemetry written": {"write": batches * units(sizes.telemetry_item, WRITE)},
        "telemetry kept": _kept(usage, batches, sizes.telemetry_item),
        "summary written": {"write": seconds_written * units(sizes.summary_item, WRITE)},
        "summary kept": _kept(usage, min(batches, usage.streams * _HOUR_S), sizes.summary_item),
        "Lambda 2": {
            "read": batches / together * units(read, READ),
            **_function(
                usage,
                calls,
                memory_mb=usage.summarize_memory_mb,
                billed_ms=usage.summarize_ms + usage.summarize_batch_ms * (batches + own) / calls,
                logged=calls * _SUMMARIZE_LINE + (batches / together + own) * _HEALTH_LINE,
            ),
        },
    }


def _own(usage: Usage) -> Table:
    """The agent's own streams, of a sample a batch; Lambda 2's calls are counted with the others."""
    own = usage.own_batches_per_s * _HOUR_S
    return {
        "batches": {"rule": own, "action": own},
        "telemetry and summary": {"write": 2 * own, "read": own},
        "kept": _kept(usage, 2 * own, OWN_ITEM_BYTES),
    }


def _live(usage: Usage) -> Table:
    by_pubnub = usage.live_per_s * _HOUR_S if usage.live_transport == PUBNUB else 0.0
    logged = _live_lines_per_s(usage) * _HOUR_S / usage.robots * _LIVE_LINE + by_pubnub * _LIVE_VALUES
    function = _function(
        usage, by_pubnub, memory_mb=usage.live_memory_mb, billed_ms=usage.live_ms, logged=logged
    )
    # Two more rules, for faults and a low battery, evaluate each that passes the broker; an action is billed.
    passing = usage.live_at_broker_per_s * _HOUR_S
    table = {
        "leases, sent and received": {"message": 2 * usage.leases_per_s * _HOUR_S},
        "messages": {"message": passing, "rule": 2 * passing, "action": 2 * passing},
        "Lambda 1": {"rule": by_pubnub, "action": by_pubnub, **function},
    }
    if usage.live_transport == IOT:
        minutes = 60 * usage.watched * usage.viewers / usage.robots
        table["viewers"] = {"message": passing * usage.viewers, "connection": minutes}
    return table


def _commands(usage: Usage) -> Table:
    return {"sent, received, acknowledged": {"message": _COMMAND_MESSAGES * usage.command_hz * _HOUR_S}}


def _questions(usage: Usage) -> Table:
    """Questions that fit into a message, with their answers."""
    asked = usage.questions_per_hour
    memory_mb = max(question.memory_mb for question in QUESTIONS.values())
    return {
        "questions and answers": {"message": _QUESTION_MESSAGES * asked, "rule": asked, "action": asked},
        "answer": {
            # Counted in the robot's row.
            "write": asked,
            "read": asked * _QUESTION_READS,
            **_function(
                usage, asked, memory_mb=memory_mb, billed_ms=_QUESTION_MS, logged=asked * _ANSWER_LINE
            ),
        },
    }


def _ping(usage: Usage) -> Table:
    """Ping and pong on each path; two of the three paths pass a rule, and one passes a function."""
    clock, pings = usage.clock_pings_per_s * _HOUR_S, usage.ping_hz * _HOUR_S
    return {
        "clock pings and pongs": {"message": 2 * clock, "rule": clock, "action": clock},
        "pings and pongs": {"message": 6 * pings, "rule": 2 * pings, "action": 2 * pings},
        "echo": _function(usage, pings, memory_mb=256, billed_ms=5.0, logged=pings * _PONG_LINE),
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
        moved=archived if is_moved else 0.0,
        small=own_archived + (0.0 if is_moved else archived),
    )


def _archive(usage: Usage) -> Table:
    """What docs/reference/archive.md tells, kept for ``archive_days``. Deleting objects is free."""
    hour, days = recorded(usage), usage.archive_days
    standard, rarer = min(days, STANDARD_DAYS) / MONTH_DAYS, max(0, days - STANDARD_DAYS) / MONTH_DAYS
    return {
        **_archiving(usage, hour),
        "kept": {
            "s3_standard": (hour.moved * standard + hour.small * (standard + rarer)) / 1e9,
            "s3_instant": hour.moved * rarer / 1e9,
        },
    }


def _archiving(usage: Usage, hour: Recorded) -> Table:
    streams, days = usage.streams + usage.own_streams, 1 / usage.hours_per_day
    # The schedules are the deployment's; each robot has its share.
    runs = _ARCHIVE_RUNS_A_DAY * days / usage.robots
    # An hour and a day of each stream, and each night its search.
    written, searches = streams * (1 + days), streams * days
    calls = written + searches + runs
    computing_s = _RUN_S * written + _PLAN_S * (searches + runs)
    computing_s += _ARCHIVED_SAMPLE_S * _HOUR_S * usage.samples_per_s
    ms, logged = 1000 * computing_s / calls, _ARCHIVE_LINE * calls
    sought = min(_SOUGHT_DAYS, usage.retention_days * _SOUGHT_SHARE)
    return {
        # DynamoDB bills a count as a read.
        "items read, and counted before they expire": {"read": 2 * hour.reads},
        "notes and rows": {
            "read": streams * (_ARCHIVE_ROW_READS + sought),
            "write": streams * _ARCHIVE_WRITES,
        },
        "scheduled": {"schedule": runs},
        "tasks": {"queue_request": _TASK_REQUESTS * (written + searches)},
        "archive": _function(usage, calls, memory_mb=ARCHIVE_MB, billed_ms=ms, logged=logged),
        # An hour's object is written and read once; the day's is written, and moved if it is not too small.
        "objects": {
            "s3_put": streams * (1 + days),
            "s3_get": streams * (4 + days),
            "s3_move": usage.streams * days * bool(hour.moved),
        },
    }


def drive_billed_s(cpu_s: float) -> float:
    """Billed seconds of a drive whose analysis takes a whole processor ``cpu_s``, as its function has."""
    return cpu_s + _DRIVE_S


def drive_items(usage: Usage, drives: float, billed_s: float) -> list[LineItem]:
    """The line items of ``drives`` in a robot-hour, each of ``billed_s`` seconds."""
    return list(_priced("analysis", _drives(usage, drives, billed_s), PRICES))


def _drives(usage: Usage, drives: float, billed_s: float) -> Table:
    # The functions read strongly consistent; the stream that tells of motion is read to find the drives.
    reads = _HOUR_S * sizes_of(usage.rate_hz, usage.batch_s).telemetry_item / READ
    return {
        "computing": {"compute_arm": drives * billed_s * ANALYSIS_MB / 1024},
        "invoked": {"invocation": drives},
        "a state for each drive": {"transition": drives},
        "express workflows": {"express_request": drives},
        "their duration": {"express_duration": drives * billed_s * _WORKFLOW_MB / 1024},
        "samples read": {"read": usage.batches_per_s * reads},
        "samples read to find the drives": {"read": _PLANNED_DAYS * usage.stream_batches_per_s * reads},
        "results written": {"write": drives * _DRIVE_WRITES},
        "results written, PUT": {"s3_put": drives * DRIVE_OBJECTS},
        "results read, GET": {"s3_get": drives},
    }


def _analysis(usage: Usage) -> Table:
    """Drives that are analysed in the next night."""
    drives = 60 / usage.drive_minutes
    cpu_s = _ANALYSED_SAMPLE_S * usage.samples_per_s * 60 * usage.drive_minutes
    # A night of a robot, and its share of the run.
    nights = 1 / usage.hours_per_day
    runs = nights / usage.robots
    calls = nights + _CALLS * runs
    planning = _function(
        usage,
        calls,
        memory_mb=ANALYSIS_MB,
        billed_ms=1000 * _DRIVE_S,
        logged=_ANALYSIS_LINE * (drives + calls)
        + (drives * len(PLATFORM_LINES) if usage.function_logs == "all" else 0),
    )
    kept = _RESULT_BYTES * _HOUR_S * usage.samples_per_s / 1e9 * _RESULT_MONTHS
    return {
        **_drives(usage, drives, drive_billed_s(cpu_s)),
        "planning and comparing": {**planning, "read": nights * _COMPARED_ROWS, "s3_put": nights},
        "states of the run, and of each robot": {"transition": nights + _STATES * runs},
        "results kept": {"s3_standard": kept},
        "scheduled": {"schedule": runs},
    }


# The lanes of a bill.
CAPABILITIES: dict[str, Callable[[Usage], Table]] = {
    "connection": _connection,
    "record": _record,
    "agent, rtt": _own,
    "live": _live,
    "commands": _commands,
    "ping": _ping,
    "questions": _questions,
    "archive": lambda usage: _archive(usage) if usage.archive_days else {},
    "analysis": lambda usage: _analysis(usage) if usage.drive_minutes else {},
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


def _live_lines_per_s(usage: Usage) -> float:
    """Log lines a second of the whole fleet: each environment of Lambda 1 gathers its metrics."""
    messages = usage.robots * usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    environments = max(1, ceil(messages * usage.live_ms / 1000))
    return min(messages, max(environments / _GATHER_S, messages / _MOST_VALUES))


# --- bills ----------------------------------------------------------------------------------------------


class LineItem(NamedTuple):
    """One line of a bill: ``units`` per robot-hour at the price named ``price`` in `PRICES`."""

    lane: str
    what: str
    price: str
    units: float
    # Dollars per unit; None means the built-in list price.
    each: float | None = None

    @property
    def service(self) -> str:
        return PRICES[self.price].service

    @property
    def dollars(self) -> float:
        """Dollars per robot-hour."""
        return self.units * (PRICES[self.price].each if self.each is None else self.each)


def _priced(lane: str, table: Table, prices: Mapping[str, Price]) -> Iterator[LineItem]:
    for what, by_price in table.items():
        for price, count in by_price.items():
            yield LineItem(lane, what, price, count, prices[price].each)


def bill(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[LineItem]:
    """AWS' line items for a robot-hour; PubNub's are in `pubnub_bill`."""
    usage.check()
    return [item for lane, of in CAPABILITIES.items() for item in _priced(lane, of(usage), prices)]


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
    sizes = sizes_of(usage.rate_hz, usage.batch_s)
    samples = usage.samples_per_s * _HOUR_S
    per_s = usage.robots * usage.samples_per_s
    polls = max(_THESIS_POLLS_PER_S * _shards(per_s), per_s / _THESIS_RECORDS_A_CALL)
    calls = min(per_s, polls) * _HOUR_S / usage.robots

    def function(calls: float, billed_ms: float) -> dict[str, float]:
        return _function(usage, calls, memory_mb=128, billed_ms=billed_ms, logged=0.0, compute="compute_x86")

    lanes: dict[str, Table] = {
        "connection": {"minutes": {"connection": 60}, "CONNECT": {"message": usage.connects_per_hour}},
        "record": {
            "messages": {"message": samples * units(sizes.sample, METER)},
            "rule to the table": {"rule": samples, "action": samples},
            "both tables written": {"write": 2 * samples * units(sizes.sample_item, WRITE)},
            "both tables kept": _kept(usage, 2 * samples, sizes.sample_item),
            "Lambda 2": function(calls, usage.summarize_ms),
        },
        "live": {
            "rule to Lambda 1": {"rule": samples, "action": samples},
            "Lambda 1": function(samples, usage.live_ms),
        },
    }
    return [item for lane, table in lanes.items() for item in _priced(lane, table, prices)]


def pubnub_bill(
    usage: Usage, prices: Mapping[str, Price] = PRICES, *, thesis: bool = False
) -> list[LineItem]:
    """PubNub's line items for a robot-hour on its plan by transactions."""
    usage.check()
    by_pubnub = usage.live_per_s if usage.live_transport == PUBNUB else 0.0
    size = sizes_of(usage.rate_hz, usage.batch_s).update
    messages = (usage.samples_per_s if thesis else by_pubnub) * _HOUR_S * units(size, PUBNUB_UNIT)
    table: Table = {
        "published": {"pubnub_publish": messages},
        "received by viewers": {"pubnub_receive": messages * usage.viewers},
    }
    return list(_priced("live", table, prices))


def pubnub_mau_dollars_per_month(usage: Usage) -> float | None:
    """The price of PubNub's plan by monthly active users (viewers and Lambda 1); None above the listed
    plans."""
    if usage.live_transport != PUBNUB:
        return 0.0
    users = usage.viewers + 1
    return next((dollars for most, dollars in PUBNUB_MAU_PLANS if users <= most), None)


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
    making = hours * total(_priced("archive", _archiving(usage, hour), prices))
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
    """Dollars by purpose: metrics, alarms, dashboards, queue polls, and if set Device Defender's audit and
    the account's own key.

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
    if usage.device_defender:
        table["audit of the robots"] = ("audit", usage.robots)
    if usage.customer_key:
        table["key"] = ("key", 1)
        table["requests to the key, by the queue"] = ("key_request", _KEYS_AN_HOUR * MONTH_HOURS)
    return {what: count * prices[price].each for what, (price, count) in table.items()}


def dashboard_metrics(usage: Usage) -> tuple[int, ...]:
    """The number of metrics on each dashboard, including those that a search finds."""
    if not usage.robot_metrics or not usage.dashboards:
        return usage.dashboards
    return (*usage.dashboards[:-1], usage.dashboards[-1] + ROBOT_SEARCHES * usage.robots)
