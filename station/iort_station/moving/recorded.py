"""Moves a stream's stored batches, byte for byte."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from iort_analysis.archive.hours import HourFile, is_expiring, key_of
from iort_analysis.archive.stored import ahead
from iort_analysis.samples.batches import Item
from iort_contract.dynamodb import WRITE_ITEMS, Keys, TableError, TelemetryTable, whole
from iort_contract.tables import BATCH, EXPIRES_S
from iort_station.cloud import Cloud
from iort_station.data.recorded import archive_of, telemetry_table
from iort_station.errors import StationError

# A write unit writes a kilobyte. AWS accepts 1,000 a second for a partition, which holds a whole topic. Half
# of them are left to the robot.
UNITS_PER_S = 500
_UNIT_BYTES = 1024
# The target's archive finds a batch within a day, by a sweep.
_MERGED_S = 30 * 86_400
# Receives the number of batches read.
BatchProgress = Callable[[int], None]


def copy(
    source: Cloud,
    target: Cloud,
    topic: str,
    *,
    units_per_s: int = UNITS_PER_S,
    progress: BatchProgress = lambda _batches: None,
) -> int:
    """Copy what the target's table lacks, at so many write units a second; returns the number of batches.

    Raises `StationError` if DynamoDB rejects a write. What was copied until then is good.
    """
    table, batches = telemetry_table(target), 0
    for items in ahead(page.items for page in telemetry_table(source).pages(topic)):
        new = list(_lacking(target, topic, items))
        write(table, new, units_per_s)
        batches += len(new)
        progress(len(items))
    return batches


def merge(
    source: Cloud,
    target: Cloud,
    topic: str,
    *,
    units_per_s: int = UNITS_PER_S,
    progress: BatchProgress = lambda _batches: None,
) -> int:
    """Copy what only the source's archive still has of hours that both have archived, into the target's
    table, from where its own archive takes it up; returns the number of batches."""
    ours, theirs = archive_of(source, topic), archive_of(target, topic)
    there = {row.hour: row for row in theirs.rows()}
    table, batches = telemetry_table(target), 0
    for row in ours.rows():
        their = there.get(row.hour)
        if their is None or their.content == row.content or not is_expiring(row):
            continue
        known = set(theirs.read(their, HourFile.ids))
        old = [item for item in ours.read(row, HourFile.items) if key_of(item) not in known]
        expires = {EXPIRES_S: {"N": str(int(time.time()) + _MERGED_S)}}
        new = [{**item, **expires} for item in _lacking(target, topic, old)]
        write(table, new, units_per_s)
        batches += len(new)
        progress(row.batches)
    return batches


def _lacking(target: Cloud, topic: str, items: Sequence[Item]) -> Iterator[Item]:
    """The items that the target does not have, and that DynamoDB is not about to delete."""
    if not items:
        return
    keys = Keys(items[0][BATCH], items[-1][BATCH], empty=False)
    pages = telemetry_table(target).pages(topic, keys, attributes=(BATCH,))
    there = {key_of(item) for page in pages for item in page.items}
    now_s = time.time()
    for item in items:
        expires_s = whole(item, EXPIRES_S)
        if key_of(item) not in there and (expires_s is None or expires_s > now_s):
            yield item


def write(table: TelemetryTable, items: Sequence[Mapping[str, Any]], units_per_s: int) -> None:
    """Write items at so many write units a second; raises `StationError` if DynamoDB rejects them."""
    for start in range(0, len(items), WRITE_ITEMS):
        part, began = items[start : start + WRITE_ITEMS], time.monotonic()
        try:
            table.put(part)
        except TableError as error:
            raise StationError(f"{error}; do it again, or with fewer --units") from error
        # About the units of an item, which is nearly all samples.
        units = sum(-(-len(str(item)) // _UNIT_BYTES) for item in part)
        time.sleep(max(0.0, began + units / units_per_s - time.monotonic()))
