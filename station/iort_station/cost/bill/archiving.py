"""The archive's line items, and a robot-year in it beside one in DynamoDB. Pure.

docs/reference/archive.md tells what the archive does, and when. Deleting objects is free.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from iort_station.cost.bill.line_items import ITEM_OVERHEAD, READ, LineItem, function
from iort_station.cost.prices import MONTH_DAYS, PRICES, Price
from iort_station.cost.sizes import ARCHIVED_SHARE, OWN_ITEM_BYTES, sizes_of
from iort_station.cost.usage import Usage

LANE = "archive"
# As stacks/archive.py and stacks/storage.py deploy it; a test compares them.
MEMORY_MB, RUNS_A_DAY, STANDARD_DAYS = 1769, 25, 30
# Billed seconds of an hour or a day, of 180,000 samples in it (2.2 s of processor, as measured), and of a run
# that only plans; the first and the last are assumptions.
_RUN_S, _SAMPLE_S, _PLAN_S = 0.8, 2.2 / 180_000, 0.2
# A class other than Standard bills, and the lifecycle moves, no object below this.
_LEAST_MOVED = 128 * 1024
# Hour and day have a note each, written and removed; the hour has a row, which the day writes once more, in a
# transaction of twice the price.
_WRITES = 2 + 2 + 1 + 2
_ROW_READS = 4
# Each night the hours that expire within this share of the retention, at most so many days, are looked for.
_SOUGHT_SHARE, _SOUGHT_DAYS = 0.2, 14
# A task is sent, received and deleted.
_TASK_REQUESTS = 3
_LINE = 330
_YEAR_DAYS = 365


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
    batches, own = usage.batches_per_s * 3600, usage.own_batches_per_s * 3600
    archived, own_archived = (
        count * size * ARCHIVED_SHARE for count, size in ((batches, item), (own, OWN_ITEM_BYTES))
    )
    is_moved = archived / usage.streams * usage.hours_per_day >= _LEAST_MOVED
    return Recorded(
        table=batches * (item + ITEM_OVERHEAD) + own * (OWN_ITEM_BYTES + ITEM_OVERHEAD),
        reads=(batches * item + own * OWN_ITEM_BYTES) / READ,
        moved=archived if is_moved else 0.0,
        small=own_archived + (0.0 if is_moved else archived),
    )


def items(usage: Usage) -> list[LineItem]:
    """The line items of a robot-hour, kept in the archive for ``archive_days``; none without an archive."""
    if not usage.archive_days:
        return []
    hour = recorded(usage)
    standard = min(usage.archive_days, STANDARD_DAYS) / MONTH_DAYS
    rarer = max(0, usage.archive_days - STANDARD_DAYS) / MONTH_DAYS
    return [
        *_making(usage, hour),
        LineItem(
            "S3",
            LANE,
            "kept, S3 Standard",
            "s3_standard",
            (hour.moved * standard + hour.small * (standard + rarer)) / 1e9,
        ),
        LineItem("S3", LANE, "kept, Glacier Instant Retrieval", "s3_instant", hour.moved * rarer / 1e9),
    ]


def _making(usage: Usage, hour: Recorded) -> list[LineItem]:
    """What it takes to archive a robot-hour."""
    streams = usage.streams + usage.own_streams
    days = 1 / usage.hours_per_day
    # The schedules are the deployment's; each robot has its share.
    runs = RUNS_A_DAY * days / usage.robots
    # An hour and a day of each stream, and each night its search.
    written, searches = streams * (1 + days), streams * days
    tasks = written + searches
    computing_s = _RUN_S * written + _SAMPLE_S * 3600 * usage.samples_per_s + _PLAN_S * (searches + runs)
    sought = min(_SOUGHT_DAYS, usage.retention_days * _SOUGHT_SHARE)
    return [
        # The items are read, and shortly before they expire counted; DynamoDB bills a count as a read.
        LineItem("DynamoDB", LANE, "items read, and counted before they expire", "read", 2 * hour.reads),
        LineItem("DynamoDB", LANE, "notes and rows read", "read", streams * (_ROW_READS + sought)),
        LineItem("DynamoDB", LANE, "notes and manifest written", "write", streams * _WRITES),
        LineItem("EventBridge", LANE, "scheduled", "schedule", runs),
        LineItem("SQS", LANE, "tasks", "queue_request", _TASK_REQUESTS * tasks),
        *function(
            LANE,
            "archive",
            tasks + runs,
            usage,
            memory_mb=MEMORY_MB,
            billed_ms=1000 * computing_s / (tasks + runs),
            logged=_LINE * (tasks + runs),
        ),
        # An hour's object is written and read once; the day's is written, and moved if it is not too small.
        LineItem("S3", LANE, "PUT", "s3_put", streams * (1 + days)),
        LineItem("S3", LANE, "GET and HEAD", "s3_get", streams * (4 + days)),
        LineItem(
            "S3", LANE, "moved to the cheaper class", "s3_move", usage.streams * days * bool(hour.moved)
        ),
    ]


class Place(NamedTuple):
    """Where a robot-year is kept: its bytes there, and dollars; a month, or once."""

    what: str
    size_bytes: float
    dollars: float


def robot_year(usage: Usage, prices: Mapping[str, Price] = PRICES) -> list[Place]:
    """What a robot records in a year, in DynamoDB and in the archive."""
    hours = usage.hours_per_day * _YEAR_DAYS
    table, _, moved, small = (hours * each for each in recorded(usage))
    archived = moved + small
    each = {name: price.each for name, price in prices.items()}
    making = hours * sum(item.units * each[item.price] for item in _making(usage, recorded(usage)))
    later = moved * each["s3_instant"] + small * each["s3_standard"]
    return [
        Place("in DynamoDB, a month", table, table / 1e9 * each["storage"]),
        Place(
            f"in the archive, a month of the first {STANDARD_DAYS} days",
            archived,
            archived / 1e9 * each["s3_standard"],
        ),
        Place("in the archive, a month after that", archived, later / 1e9),
        Place("from DynamoDB into the archive, once", archived, making),
        Place(
            f"read as a whole after {STANDARD_DAYS} days, each time",
            archived,
            moved / 1e9 * each["s3_instant_read"],
        ),
    ]
