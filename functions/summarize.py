"""Summarize: reads batches from the telemetry table's stream, and writes one item a second to the summary
table.

Batches of a robot over its share are put off to `functions.later`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import connect, variables
from functions.shared.metrics import emit
from functions.shared.quotas import DAY, Quota
from functions.shared.share import Change, PutOff, Share, Told, robot_of_change
from functions.shared.summary import Bounds, processed, recompute, stored_tables
from iort_contract.catalog.environments import SummarizeEnvironment
from iort_contract.tables import PUT_OFF_TO_S, RECOMPUTE_FROM_S, RECORD_BYTES, RECORD_DAY, REPLAY

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient


# What each robot records a day, counted from the batches that it reads anyway.
#
# AWS IoT has no limit of a day, so nothing is refused: a robot over its bytes is named in the log and counted
# for an alarm. Counts wait in the environment's memory and are added to the robot's row every few minutes, so
# one that ends early counts less, never more; a batch that the stream repeats counts again.

_log = logging.getLogger(__name__)
# A write of a robot's row costs as much as a batch. A robot may write this part of its day before it counts.
EVERY_S, PARTS = 300.0, 50
# DynamoDB's own bytes of an item: "DynamoDB item sizes and formats".
_ITEM_BYTES = 100
_ROBOTS = 1000


class Volume:
    """The bytes of each robot's day in its row of the registry; ``most`` is what it may record."""

    def __init__(self, client: DynamoDBClient, table: str, most: int) -> None:
        named = (RECORD_DAY, RECORD_BYTES)
        self._quota = Quota(client, table=table, named=named, period=DAY, most=most)
        self._waiting: dict[str, tuple[float, int]] = {}

    def note(self, changes: Iterable[Change], now_s: float) -> None:
        """Count the batches of stream records, and write the counts that are due."""
        for change in changes:
            robot, image = robot_of_change(change), change.get("NewImage")
            # The archive has put off the expiry of some, which writes them again, but no robot did.
            if robot and image is not None and PUT_OFF_TO_S not in image:
                since_s, size = self._waiting.get(robot, (now_s, 0))
                self._waiting[robot] = (since_s, size + size_of(image))
        for robot, (since_s, size) in list(self._waiting.items()):
            crowded = len(self._waiting) > _ROBOTS
            if crowded or now_s - since_s >= EVERY_S or size * PARTS >= self._quota.most:
                del self._waiting[robot]
                self._add(robot, size, now_s)

    def _add(self, robot: str, size: int, now_s: float) -> None:
        try:
            total = self._quota.count(robot, size, now_s)
        except (BotoCoreError, ClientError) as error:
            # No batch waits for a count.
            _log.warning("%d bytes of %s are not counted: %s", size, robot, error)
            return
        if total > self._quota.most:
            _log.warning("%s has recorded %d bytes today, more than its %d", robot, total, self._quota.most)
            emit("summarize", RobotsOverVolume=1)


def size_of(image: Mapping[str, Mapping[str, Any]]) -> int:
    """About the size of an item: its names and texts, and its samples, in base64 or not."""
    return _ITEM_BYTES + sum(len(name) + _length(value) for name, value in image.items())


def _length(value: Mapping[str, Any]) -> int:
    ((kind, content),) = value.items()
    if kind == "B":
        # A stream's event has bytes in base64.
        return len(content) * 3 // 4 if isinstance(content, str) else len(content)
    return len(content) if isinstance(content, str) else len(repr(content))


# Most environments never put anything off, and need no client for it.
@cache
def _bounds() -> Bounds:
    return Bounds(Share(), lambda changes: _put_off().put(changes), lambda *said: _told().tell(*said))


@cache
def _volume() -> Volume:
    given = variables(SummarizeEnvironment)
    return Volume(clients.dynamodb(), given.robots_table, given.record_bytes_a_day)


@cache
def _put_off() -> PutOff:
    return PutOff(clients.sqs(), variables(SummarizeEnvironment).put_off_queue)


@cache
def _told() -> Told:
    # No robot's summary waits for an unavailable service.
    config = Config(connect_timeout=1, read_timeout=2, retries={"total_max_attempts": 1})
    return Told(connect("iot-data", config=config))


def handler(event: dict[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the telemetry table's stream mapping, and of the operator's replays."""
    if RECOMPUTE_FROM_S in event:
        return recompute(event, stored_tables())
    if event.get(REPLAY):
        # The operator's replays are not charged to a robot, and the stream continues meanwhile.
        return processed(event, beside_others=True)
    answer = processed(event, bounds=_bounds())
    left = {one["itemIdentifier"] for one in answer["batchItemFailures"]}
    changes = (record["dynamodb"] for record in event["Records"])
    _volume().note((one for one in changes if one["SequenceNumber"] not in left), time.time())
    return answer
