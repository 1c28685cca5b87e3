"""Says what the archive has to do, and puts it into the queue of the archive's function, a task each."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from functions.shared.archive.archive import Archive
from functions.shared.archive.expiry import margin_s
from functions.shared.metrics import emit
from functions.shared.queues import send_all
from iort_contract.archive import (
    ARCHIVE,
    DUE_MS,
    FIRST_DUE_MS,
    HOUR,
    HOUR_REST_MS,
    HOUR_US,
    JOIN,
    PUT_OFF,
    SAFE_UNTIL_S,
    SWEEP,
    TASK,
    Hour,
    Pending,
    hours_between,
    stored_hours,
)
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.dynamodb import plain, starting_between
from iort_contract.tables import BATCH, ROBOT, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic

# A mark that is due for longer than this waits for something to be mended.
OVERDUE_MS = 3 * 3_600_000
# Batches that keep coming delay their hour by no more than this.
_DELAYED_MS = 3_600_000
# What expires within two nights, a sweep must find.
_SOON_S = 2 * 86_400
# A night's sweep counts the hours of a day, and two more.
_COUNTED_US = 26 * HOUR_US


class QueueError(Exception):
    """The queue did not take all tasks; the next run sends them again."""


def plan_due(archive: Archive, now_ms: int) -> dict[str, int]:
    """Queue every hour and day that is due, and every expiry that must be put off."""
    tasks: list[dict[str, Any]] = []
    overdue = 0
    for pending, row in archive.marks.every():
        due_ms = int(row[DUE_MS]["N"])
        first_ms = int(row[FIRST_DUE_MS if FIRST_DUE_MS in row else DUE_MS]["N"])
        if due_ms > now_ms and first_ms > now_ms - _DELAYED_MS:
            continue
        is_late = first_ms < now_ms - OVERDUE_MS
        overdue += is_late
        safe_s = int(row[SAFE_UNTIL_S]["N"]) if SAFE_UNTIL_S in row else 0
        if is_late and not pending.is_day and safe_s <= now_ms // 1000 + margin_s(archive.given.retention_s):
            tasks.append(_task(PUT_OFF, pending))
        tasks.append({**_task(JOIN if pending.is_day else ARCHIVE, pending), DUE_MS: due_ms})
    _send(archive, tasks)
    emit("archive", TasksOverdue=overdue)
    return {"tasks": len(tasks), "overdue": overdue}


def plan_sweeps(archive: Archive) -> dict[str, int]:
    """Queue a sweep of every stream in the registry."""
    tasks = [{TASK: SWEEP, TOPIC: topic} for topic in _topics(archive)]
    _send(archive, tasks)
    return {"tasks": len(tasks)}


def _topics(archive: Archive) -> Iterator[str]:
    pages = archive.client.get_paginator("scan").paginate(
        TableName=archive.given.robots_table,
        ProjectionExpression="#robot, #streams",
        ExpressionAttributeNames={"#robot": ROBOT, "#streams": STREAMS},
    )
    for page in pages:
        for item in page["Items"]:
            row = plain(item)
            for stream in sorted({VESC_STREAM, *OWN_STREAMS, *row.get(STREAMS, ())}):
                yield build_topic(RECORD, row[ROBOT], stream, archive.given.namespace)


def sweep(archive: Archive, topic: str, now_ms: int, *, every: bool) -> dict[str, int]:
    """Queue the hours of a stream that are over and not archived: those that expire soon, which have lost
    their mark, or ``every`` one, also with batches that came late.

    An hour that begins to expire soon is counted once more: a late batch may have lost its mark.
    """
    retention_s = archive.given.retention_s
    until_us = (now_ms - HOUR_REST_MS) * 1000
    if not every:
        soon_s = min(retention_s, max(2 * margin_s(retention_s), _SOON_S))
        until_us -= (retention_s - soon_s) * 1_000_000
    # The hours of a clock that is ahead are over when their items have long expired.
    ahead_us = now_ms * 1000 + HOUR_US
    stored = [
        *stored_hours(archive.telemetry, topic, until_us),
        *stored_hours(archive.telemetry, topic, None, from_us=ahead_us),
    ]
    archived = _counts(archive, topic, stored)
    marks = archive.marks.every() if every else ()
    marked = {pending.period for pending, _ in marks if pending.topic == topic}
    counted_us = until_us if every else until_us - _COUNTED_US
    found = [
        Pending(topic, str(hour))
        for hour in stored
        if str(hour) in marked
        or str(hour) not in archived
        or (counted_us < hour.end_us <= until_us and _count(archive, topic, hour) > archived[str(hour)])
    ]
    for pending in found:
        if not every:
            archive.marks.add(pending, 0)
    tasks = [_task(ARCHIVE, pending) for pending in found]
    _send(archive, tasks)
    return {"tasks": len(tasks)}


def _counts(archive: Archive, topic: str, hours: Sequence[Hour]) -> dict[str, int]:
    """The number of items in the archive by hour, of these hours."""
    if not hours:
        return {}
    pages = archive.manifest.pages(
        topic, hours_between(hours[0], hours[-1]), attributes=(HOUR, "batches", "refused")
    )
    rows = (plain(item) for page in pages for item in page.items)
    return {row[HOUR]: int(row["batches"] + row["refused"]) for row in rows}


def _count(archive: Archive, topic: str, hour: Hour) -> int:
    """The number of items in the table."""
    keys = starting_between(hour.start_us, hour.end_us - 1)
    return sum(len(page.items) for page in archive.telemetry.pages(topic, keys, attributes=(BATCH,)))


def _task(kind: str, pending: Pending) -> dict[str, Any]:
    return {TASK: kind, TOPIC: pending.topic, HOUR: pending.period}


def _send(archive: Archive, tasks: Iterable[Mapping[str, Any]]) -> None:
    messages = [{"MessageBody": json.dumps(task)} for task in tasks]
    if left := send_all(archive.queue, archive.given.archive_queue, messages):
        raise QueueError(f"{len(left)} of {len(messages)} tasks are not queued")
