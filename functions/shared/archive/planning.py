"""Says what the archive has to do, and puts it into the queue of the archive's function, a task each."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from functions.shared.archive.archive import Archive
from functions.shared.archive.expiry import margin_s
from functions.shared.metrics import emit
from functions.shared.queues import send_all
from iort_contract.archive import (
    ARCHIVE,
    DUE_MS,
    HOUR,
    HOUR_REST_MS,
    JOIN,
    PUT_OFF,
    SAFE_UNTIL_S,
    SWEEP,
    TASK,
    Pending,
    hours_between,
    stored_hours,
)
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.dynamodb import Item, plain
from iort_contract.tables import ROBOT, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic

# A mark that is due for longer than this waits for something to be mended.
OVERDUE_MS = 3 * 3_600_000


class QueueError(Exception):
    """The queue did not take all tasks; the next run sends them again."""


def plan_due(archive: Archive, now_ms: int) -> dict[str, int]:
    """Queue every hour and day that is due, and every expiry that must be put off."""
    tasks: list[dict[str, Any]] = []
    overdue = 0
    for pending, row in archive.marks.every():
        due_ms = int(row[DUE_MS]["N"])
        if due_ms > now_ms:
            continue
        is_late = due_ms < now_ms - OVERDUE_MS
        overdue += is_late
        safe_s = int(row[SAFE_UNTIL_S]["N"]) if SAFE_UNTIL_S in row else 0
        if is_late and not pending.is_day and safe_s <= now_ms // 1000 + margin_s(archive.given.retention_s):
            tasks.append(_task(PUT_OFF, pending))
        tasks.append(_task(JOIN if pending.is_day else ARCHIVE, pending))
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
    their mark, or ``every`` one, also with batches that came late."""
    retention_s = archive.given.retention_s
    until_us = (now_ms - HOUR_REST_MS) * 1000
    if not every:
        until_us -= (retention_s - 2 * margin_s(retention_s)) * 1_000_000
    archived = {item[HOUR]["S"] for item in _rows(archive, topic)}
    marks = archive.marks.every() if every else ()
    marked = {pending.period for pending, _ in marks if pending.topic == topic}
    found = [
        Pending(topic, str(hour))
        for hour in stored_hours(archive.telemetry, topic, until_us)
        if str(hour) not in archived or str(hour) in marked
    ]
    for pending in found:
        if not every:
            archive.marks.add(pending, 0)
    tasks = [_task(ARCHIVE, pending) for pending in found]
    _send(archive, tasks)
    return {"tasks": len(tasks)}


def _rows(archive: Archive, topic: str) -> Iterator[Item]:
    for page in archive.manifest.pages(topic, hours_between(None, None), attributes=(HOUR,)):
        yield from page.items


def _task(kind: str, pending: Pending) -> dict[str, Any]:
    return {TASK: kind, TOPIC: pending.topic, HOUR: pending.period}


def _send(archive: Archive, tasks: Iterable[Mapping[str, Any]]) -> None:
    messages = [{"MessageBody": json.dumps(task)} for task in tasks]
    if left := send_all(archive.queue, archive.given.archive_queue, messages):
        raise QueueError(f"{len(left)} of {len(messages)} tasks are not queued")
