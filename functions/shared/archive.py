"""The adapters of the archive's writer, from its environment."""

from __future__ import annotations

import heapq
import logging
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.quotas import RateLimiter
from iort_contract.archive import (
    DUE_MS,
    HOUR,
    PENDING,
    ArchivedHour,
    ArchiveTable,
    Hour,
    Pending,
    hour_of,
    parse_pending,
)
from iort_contract.catalog.environments import ArchiveEnvironment
from iort_contract.dynamodb import Item, TelemetryTable, quick
from iort_contract.objects import Objects
from iort_contract.topics import parse_topic

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_sqs import SQSClient


_log = logging.getLogger(__name__)
# How many hours an environment remembers to have marked.
_KNOWN = 50_000
# Marks of a robot: at once, and a day. A car with 200 streams makes 4,800 a day; one that invents hours, by
# the times of its batches, has no more. The daily sweep finds what has no mark, before it expires.
MARKS, MARKS_A_DAY = 5_000, 5_000


class Marks:
    """The pending rows."""

    def __init__(self, client: DynamoDBClient, table: str) -> None:
        self._client, self._table = client, table
        self._known: dict[Pending, int] = {}
        self._limiter = RateLimiter(burst=MARKS, a_second=MARKS_A_DAY / 86_400)

    def note(self, topic: str, times_us: Iterable[int], now_ms: int) -> None:
        """Mark the hours of batches that start at these times. A mark covers all batches that follow before
        it is due, so a live stream costs a write an hour.

        A failure is logged: the next batch tries again, and the daily sweep finds what has no mark.
        """
        robot, beyond = parse_topic(topic).robot, 0
        for hour in {hour_of(t_us) for t_us in times_us}:
            pending = Pending(topic, str(hour))
            if now_ms < self._known.get(pending, 0):
                continue
            if self._limiter.left(robot, now_ms / 1000) < 1:
                beyond += 1
                continue
            self._limiter.spend(robot, now_ms / 1000, 1)
            try:
                due_ms = self.add(pending, now_ms)
            except (BotoCoreError, ClientError) as error:
                _log.warning("%s of %s is not marked for the archive: %s", hour, topic, error)
                continue
            if len(self._known) >= _KNOWN:
                self._known.clear()
            self._known[pending] = due_ms
        if beyond:
            _log.warning("%d hours of %s are beyond its marks a day: a sweep archives them", beyond, topic)

    def add(self, pending: Pending, now_ms: int) -> int:
        """Mark one, or move its mark to a later time; returns when it is due."""
        return ArchiveTable(self._client, self._table).mark(pending, now_ms)

    def due_ms(self, pending: Pending) -> int | None:
        """When one is due; None if it has no mark."""
        answer = self._client.get_item(TableName=self._table, Key=pending.key, ConsistentRead=True)
        return int(answer["Item"][DUE_MS]["N"]) if "Item" in answer else None

    def remove(self, pending: Pending, due_ms: int) -> bool:
        """Remove a mark that is done, unless it has moved since; returns whether it is gone."""
        with suppress(self._client.exceptions.ConditionalCheckFailedException):
            self._client.delete_item(
                TableName=self._table,
                Key=pending.key,
                ConditionExpression="#due = :due",
                ExpressionAttributeNames={"#due": DUE_MS},
                ExpressionAttributeValues={":due": {"N": str(due_ms)}},
            )
            return True
        return False

    def done(self, pending: Pending, due_ms: int | None, now_ms: int) -> None:
        """Remove a mark whose work is done. One that was not due, or has moved, stays and begins anew."""
        if due_ms is None or (due_ms <= now_ms and self.remove(pending, due_ms)):
            return
        self._update(pending, "SET #first = #due", "#first < #due")

    def every(self) -> Iterator[tuple[Pending, Item]]:
        """All marks, oldest hours first."""
        table = ArchiveTable(self._client, self._table)
        of_partitions = (chain.from_iterable(page.items for page in table.pages(one)) for one in PENDING)
        for item in heapq.merge(*of_partitions, key=lambda item: str(item[HOUR]["S"])):
            yield parse_pending(item), item

    def keep(self, pending: Pending, **values: int) -> None:
        """Add numbers to a mark that is there."""
        change = "SET " + ", ".join(f"{name} = :{name}" for name in values)
        self._update(pending, change, "attribute_exists(#due)", **values)

    def _update(self, pending: Pending, change: str, condition: str, **values: int) -> None:
        ArchiveTable(self._client, self._table).change(pending, change, condition, **values)


@dataclass(frozen=True)
class Archive:
    """The tables, the bucket and the queue."""

    client: DynamoDBClient
    telemetry: TelemetryTable
    manifest: ArchiveTable
    marks: Marks
    objects: Objects
    queue: SQSClient
    given: ArchiveEnvironment

    def row(self, topic: str, hour: Hour) -> ArchivedHour | None:
        """An hour's row of the manifest."""
        return self.manifest.row(topic, hour)


@cache
def archive() -> Archive:
    """The archive of this environment's deployment."""
    given = variables(ArchiveEnvironment)
    client = quick(clients.dynamodb())
    return Archive(
        client,
        TelemetryTable(client, given.telemetry_table),
        ArchiveTable(client, given.archive_table),
        Marks(client, given.archive_table),
        Objects(clients.s3(), given.files_bucket),
        clients.sqs(),
        given,
    )
