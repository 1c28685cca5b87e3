"""Archive: moves finished hours of every stream from the telemetry table to Parquet in the files' bucket.

The schedule says every hour what is due, and once a day that what has lost its mark is to be found; the
operator says `iort archive run`. What is to be done becomes tasks in the function's own queue. Nothing
expires before it is in the archive: the expiry of late items is put off.
"""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any

from functions.shared.archive import Archive, archive
from functions.shared.metrics import emit
from functions.shared.queues import send_all
from iort_contract.archive import (
    ALL,
    ARCHIVE,
    DUE,
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
    ArchivedHour,
    Hour,
    Pending,
    archived_hour,
    hour_of,
    hours_between,
    parse_hour,
    stored_hours,
)
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.dynamodb import plain, starting_between, whole
from iort_contract.limits import ContractError
from iort_contract.tables import BATCH, EXPIRES_S, PUT_OFF_TO_S, ROBOT, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic, parse_topic

_DAY_S = 86_400
PUT_OFF_S = 30 * _DAY_S


def margin_s(retention_s: int) -> int:
    """An hour that is not archived this long before its items expire has their expiry put off."""
    return min(retention_s // 10, 7 * _DAY_S)


def put_off(archive: Archive, pending: Pending, now_ms: int) -> int:
    """Put off the expiry of an hour's items that expire soon; returns their number."""
    hour, now_s = parse_hour(pending.period), now_ms // 1000
    margin = margin_s(archive.given.retention_s)
    safe_s, count = now_s + PUT_OFF_S, 0
    keys = starting_between(hour.start_us, hour.end_us - 1)
    for page in archive.telemetry.pages(pending.topic, keys, attributes=(TOPIC, BATCH, EXPIRES_S)):
        for item in page.items:
            expires_s = whole(item, EXPIRES_S)
            if expires_s is None:
                continue
            if expires_s > now_s + margin:
                safe_s = min(safe_s, expires_s)
                continue
            # One that has gone meanwhile must not come back as a row of an expiry alone.
            with suppress(archive.client.exceptions.ConditionalCheckFailedException):
                archive.client.update_item(
                    TableName=archive.telemetry.name,
                    Key={name: item[name] for name in (TOPIC, BATCH)},
                    UpdateExpression="SET #expires = :expires, #put_off = :expires",
                    ConditionExpression="#expires = :before",
                    ExpressionAttributeNames={"#expires": EXPIRES_S, "#put_off": PUT_OFF_TO_S},
                    ExpressionAttributeValues={
                        ":expires": {"N": str(now_s + PUT_OFF_S)},
                        ":before": item[EXPIRES_S],
                    },
                )
                count += 1
    archive.marks.keep(pending, **{SAFE_UNTIL_S: safe_s})
    emit("archive", ExpiriesPutOff=count)
    return count


# A mark that is due for longer than this waits for something to be mended.
OVERDUE_MS = 3 * 3_600_000
# Batches that keep coming delay their hour by no more than this.
_DELAYED_MS = 3_600_000
# Hours and days of a robot that an hourly plan queues. A car with 200 streams has as many an hour; what is
# beyond keeps its mark for the next plan, and its expiry is put off like that of any late hour.
MOST_OF_A_ROBOT = 250
# What expires within two nights, a sweep must find.
_SOON_S = 2 * 86_400
# A night's sweep counts the hours that begin to expire soon within a day, and two hours more.
_COUNTED_S = 26 * 3600


class QueueError(Exception):
    """The queue did not take all tasks; the next run sends them again."""


def plan_due(archive: Archive, now_ms: int) -> dict[str, int]:
    """Queue every hour and day that is due, and every expiry that must be put off."""
    tasks: list[dict[str, Any]] = []
    overdue, waiting, queued = 0, 0, Counter[str]()
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
        robot = parse_topic(pending.topic).robot
        if queued[robot] == MOST_OF_A_ROBOT:
            waiting += 1
            continue
        queued[robot] += 1
        tasks.append({**_task(JOIN if pending.is_day else ARCHIVE, pending), DUE_MS: due_ms})
    _send(archive, tasks)
    emit("archive", TasksOverdue=overdue)
    return {"tasks": len(tasks), "overdue": overdue, "waiting": waiting}


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

    An archived hour that begins to expire soon, also one of a clock that was wrong, is counted once more: a
    late batch may have lost its mark.
    """
    retention_s = archive.given.retention_s
    soon_s = min(retention_s, max(2 * margin_s(retention_s), _SOON_S))
    until_us = (now_ms - HOUR_REST_MS) * 1000
    if not every:
        until_us -= (retention_s - soon_s) * 1_000_000
    # The hours of a clock that is ahead are over when their items have long expired.
    ahead_us = now_ms * 1000 + HOUR_US
    stored = [
        *stored_hours(archive.telemetry, topic, until_us),
        *stored_hours(archive.telemetry, topic, None, from_us=ahead_us),
    ]
    archived = _archived(archive, topic, min([*stored, hour_of(until_us)]))
    marks = archive.marks.every() if every else ()
    marked = {pending.period for pending, _ in marks if pending.topic == topic}
    found = [Pending(topic, str(hour)) for hour in stored if str(hour) in marked or str(hour) not in archived]
    if not every:
        soon_s += now_ms // 1000
        found += [
            Pending(topic, hour)
            for hour, row in archived.items()
            if soon_s - _COUNTED_S < row.first_expires_s <= soon_s
            and _count(archive, topic, parse_hour(hour)) > row.batches + row.refused
        ]
    for pending in found:
        if not every:
            archive.marks.add(pending, 0)
    tasks = [_task(ARCHIVE, pending) for pending in found]
    _send(archive, tasks)
    return {"tasks": len(tasks)}


def _archived(archive: Archive, topic: str, first: Hour) -> dict[str, ArchivedHour]:
    """The archived hours since the first one; one whose row is damaged counts as not archived."""
    rows = {}
    for page in archive.manifest.pages(topic, hours_between(first, None)):
        for item in page.items:
            with suppress(ContractError):
                row = archived_hour(item)
                rows[row.hour] = row
    return rows


def _count(archive: Archive, topic: str, hour: Hour) -> int:
    """The number of items in the table."""
    keys = starting_between(hour.start_us, hour.end_us - 1)
    return sum(len(page.items) for page in archive.telemetry.pages(topic, keys, attributes=(BATCH,)))


def _task(kind: str, pending: Pending) -> dict[str, Any]:
    return {TASK: kind, TOPIC: pending.topic, HOUR: pending.period}


def _send(archive: Archive, tasks: Iterable[Mapping[str, Any]]) -> None:
    # AWS recognises a robot with many tasks by its group, and serves the others first: "SQS fair queues".
    messages = [
        {"MessageBody": json.dumps(task), "MessageGroupId": parse_topic(task[TOPIC]).robot} for task in tasks
    ]
    if left := send_all(archive.queue, archive.given.archive_queue, messages):
        raise QueueError(f"{len(left)} of {len(messages)} tasks are not queued")


_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)


class TaskError(ValueError):
    """A task that this function does not know."""


def handler(event: dict[str, Any], _context: object) -> dict[str, int]:
    """Entry point of the schedules, of the queue's mapping (a task at a time), and of the operator."""
    told: dict[str, int] = {}
    for task in (
        [json.loads(record["body"]) for record in event["Records"]] if "Records" in event else [event]
    ):
        told = perform(task, int(time.time() * 1000))
        _log.info("%s: %s", json.dumps(task), json.dumps(told))
    return told


def perform(task: dict[str, Any], now_ms: int) -> dict[str, int]:
    """Do a task; returns what was done, in numbers."""
    kind = task[TASK]
    if kind == DUE:
        return plan_due(archive(), now_ms)
    if kind == SWEEP and TOPIC not in task:
        return plan_sweeps(archive())
    if kind == SWEEP:
        return sweep(archive(), task[TOPIC], now_ms, every=bool(task.get(ALL)))
    if kind == PUT_OFF:
        return {"put_off": put_off(archive(), Pending(task[TOPIC], task[HOUR]), now_ms)}
    return _write(task, now_ms)


def _write(task: dict[str, Any], now_ms: int) -> dict[str, int]:
    # Only here is pyarrow needed: expiries are put off even where it fails to load.
    from functions.shared.archive_writer import archive_hour, join_day  # noqa: PLC0415 - see above

    pending = Pending(task[TOPIC], task[HOUR])
    if DUE_MS in task and archive().marks.due_ms(pending) is None:
        # Behind a long queue every plan asks for the same again, and the first task has done it.
        return {}
    if task[TASK] == ARCHIVE:
        row = archive_hour(archive(), pending, now_ms)
        return {"samples": row.samples, "bytes": row.size_bytes} if row else {}
    if task[TASK] == JOIN:
        return {"joined": join_day(archive(), pending, now_ms)}
    raise TaskError(f"{TASK} must be {DUE}, {SWEEP}, {ARCHIVE}, {JOIN} or {PUT_OFF}, got {task[TASK]}")
