"""Archive: moves finished hours of every stream from the telemetry table to Parquet in the files' bucket.

The schedule says every hour what is due, and once a day that what has lost its mark is to be found; the
operator says `iort archive run`. What is to be done becomes tasks in the function's own queue.
"""

from __future__ import annotations

import json
import logging
import time
from typing import Any

from functions.shared.archive.archive import archive
from functions.shared.archive.expiry import put_off
from functions.shared.archive.planning import plan_due, plan_sweeps, sweep
from iort_contract.archive import ALL, ARCHIVE, DUE, DUE_MS, HOUR, JOIN, PUT_OFF, SWEEP, TASK, Pending
from iort_contract.tables import TOPIC

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
    from functions.shared.archive.days import join_day  # noqa: PLC0415 - see above
    from functions.shared.archive.hours import archive_hour  # noqa: PLC0415 - see above

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
