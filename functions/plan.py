"""Plan: finds the drives to analyse, first step of the state machine `analysis`.

Without a robot it writes the run's robots to the bucket, an item a robot; with one the robot's drives, an
item a drive.
"""

from __future__ import annotations

import logging
import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np

from functions.shared import clients, recordings
from functions.shared.analysis import NOT_COMPARED, Kept, failed_plans
from functions.shared.clients import variables
from functions.shared.recordings import Recordings
from iort_analysis.drives.drive import Motion, motion_among
from iort_analysis.drives.stretches import STAND_US, Heard, Stretch, find
from iort_analysis.samples.batches import Item, RefusedItems, blocks
from iort_contract.catalog.environments import PlanEnvironment
from iort_contract.cloud import plan_key, robots_key, waiting_key
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.analysis import (
    AnalysisRequest,
    DriveKey,
    Finding,
    PlannedDrive,
    decode_request,
    encode_planned,
    encode_request,
)
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH

_log = logging.getLogger(__name__)
_END_US = 2**53
# A robot is compared with so many others: the whole fleet, up to a size that is read in some megabytes.
OTHERS = 50
# A drive may have begun so long before the range.
_BEFORE_US = tuple(seconds * 1_000_000 for seconds in (120, 1_800, 28_800))


def selected(request: AnalysisRequest, fleet: Sequence[str]) -> list[dict[str, Any]]:
    """The robots of a run, each with those of the ``fleet`` that it is compared with: the next ones by name,
    around."""
    items = []
    for robot in request.robots or fleet:
        place = bisect_right(fleet, robot)
        around = chain(fleet[place:], fleet[:place])
        items.append({"robot": robot, "others": list(islice((o for o in around if o != robot), OTHERS))})
    return items


def planned(robot: str, request: AnalysisRequest, recordings: Recordings) -> list[PlannedDrive]:
    """The robot's drives that have samples in the range, each from its own beginning to its end."""
    fields = {
        stream: names
        for stream in recordings.registered(robot).streams
        if (names := recordings.fields(robot, stream, request.start_us, request.end_us)) is not None
    }
    if not fields:
        return []
    motion = motion_among(fields)
    # Without a speed every stream is as good, and only pauses and runs cut.
    heard = _Heard(recordings, robot, min(fields) if motion is None else motion.stream, motion)
    drives = heard.drives(request)
    if not drives and motion is not None:
        # Recorded, and never moved: its longest stand is looked at, which says so.
        stands = _Heard(recordings, robot, motion.stream, None).drives(request)
        drives = sorted(stands, key=lambda one: one.last_us - one.start_us)[-1:]
    return [
        PlannedDrive(
            DriveKey(robot, found.start_us, found.run),
            found.last_us + MAX_BATCH_SPAN_US - 1,
            tuple(sorted(fields)),
            "" if motion is None else motion.stream,
        )
        for found in drives
    ]


class _Heard:
    """The batches of the stream that tells of ``motion``; without it only pauses and runs cut."""

    def __init__(self, recordings: Recordings, robot: str, stream: str, motion: Motion | None) -> None:
        self._recordings, self._robot, self._stream, self._motion = recordings, robot, stream, motion
        self._refused = RefusedItems()

    def drives(self, request: AnalysisRequest) -> list[Stretch]:
        """The drives that have samples in the range."""
        batches = self.between(self.beginning_us(request.start_us), _END_US)
        return [one for one in find(batches, request.end_us) if one.last_us >= request.start_us]

    def beginning_us(self, start_us: int) -> int:
        """The time from which on to look: that of the range, or where a drive began that goes on there."""
        for before_us in _BEFORE_US:
            drives = find(self.between(max(0, start_us - before_us), start_us))
            first_us = min(
                (one.start_us for one in drives if one.last_us >= start_us - STAND_US), default=None
            )
            if first_us is None:
                break
            if first_us > start_us - before_us + STAND_US:
                return first_us
        return start_us

    def between(self, start_us: int, end_us: int) -> Iterator[Heard]:
        """The batches with samples in a range."""
        items = self._recordings.items(self._robot, self._stream, start_us, end_us, refused=self._refused)
        for item in items:
            # What is not a batch has no time.
            with suppress(ContractError, KeyError):
                yield Heard(batch_id(item[BATCH]["S"]), partial(self._moves, item))
        if self._refused.count:
            told = self._robot, self._refused.count, self._refused.reason
            _log.warning("%s: %d stored items cannot be read; the first: %s", *told)

    def _moves(self, item: Item) -> bool:
        """Whether the car moves in a batch, or nobody knows."""
        if self._motion is None:
            return True
        for block in blocks([[item]], self._refused, self._motion.field.__eq__):
            moves = self._motion.moves(block.columns)
            return moves is None or bool(moves.any() or np.isnan(block.columns[self._motion.field]).all())
        return False


def unknown_to(
    table: FindingsTable, drives: list[PlannedDrive], failed: Sequence[Finding]
) -> list[PlannedDrive]:
    """The drives that have not been analysed up to their end, or whose comparison has ``failed``."""
    if not drives:
        return []
    # Runs at the same time are in the order of their ends.
    starts_us = [one.drive.start_us for one in drives]
    rows = table.drives(drives[0].drive.robot, min(starts_us), max(starts_us) + 1)
    done = {(one.drive, one.end_us) for one in rows}
    ranges = [(one.from_us, one.to_us) for one in failed if one.subject == NOT_COMPARED]
    return [
        one
        for one in drives
        if (one.drive, one.end_us) not in done or any(a <= one.drive.start_us < b for a, b in ranges)
    ]


def handler(event: Mapping[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the states Robots, with an ``input``, and Plan, with a ``robot``."""
    now_us = time.time_ns() // 1000
    given = variables(PlanEnvironment)
    kept = Kept(clients.s3(), given.files_bucket)
    if "robot" not in event:
        request, job = decode_request(event["input"], now_us), event["job"]
        robots = selected(request, recordings.deployed().robots())
        kept.put_json(robots_key(job), robots)
        return {**encode_request(request), "robots": len(robots), "job": job, "began_us": now_us}
    request, job = decode_request({**event, "robots": []}, now_us), event["job"]
    robot, table = event["robot"], FindingsTable(clients.dynamodb(), given.findings_table)
    failed = failed_plans(table, robot, request.start_us, request.end_us, again=request.again)
    start_us = min([request.start_us, *(one.from_us for one in failed)])
    drives = planned(robot, replace(request, start_us=start_us), recordings.deployed())
    if not request.again:
        drives = unknown_to(table, drives, failed)
    if request.most and len(drives) > request.most:
        # The first ones: the next run goes on where this one ends.
        drives.sort(key=lambda one: str(one.drive))
        rest = drives[request.most :]
        drives = drives[: request.most]
        waiting = {"drives": len(rest), "start_us": rest[0].drive.start_us, "end_us": request.end_us}
        kept.put_json(waiting_key(job, robot), waiting)
    key = plan_key(job, robot, drives=bool(drives))
    kept.put_json(key, [encode_planned(one) for one in drives])
    return {"drives": len(drives)}
