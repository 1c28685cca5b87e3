"""The archive of finished hours: the names of its objects in the files' bucket, and the rows of its manifest.

An hour is one of UTC, and has the batches whose first sample lies in it.
"""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any, Iterable, Iterator, Mapping, NamedTuple

from iort_contract.checks import checked, text
from iort_contract.dynamodb import Item, Keys, TelemetryTable, TopicTable, plain, starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import read
from iort_contract.tables import BATCH, ENVELOPE, TOPIC
from iort_contract.topics import Topic

ARCHIVE_PREFIX = "archive/"
# The manifest's sort key: the hour, such as 2026-11-22T07.
HOUR = "hour"
# The manifest's partitions of what is to be done: an hour to archive, or a day whose hours are to be joined.
# The sort key is the hour or the date, `#` and the topic. It stands for all batches that Lambda 2 saw before
# ``due_ms``. At a full hour every stream of the fleet is marked, and a partition takes 1,000 writes a second.
PENDING, DUE_MS = tuple(f"pending{part}" for part in range(8)), "due_ms"
# In a pending row: when it was due at first. Late batches move ``due_ms``, and this stays.
FIRST_DUE_MS = "first_due_ms"
# In a pending row: until then no item of the hour expires, since its expiry was put off.
SAFE_UNTIL_S = "safe_until_s"
# An hour is over for this long before it is archived, and a day before its hours are joined, so that late
# batches seldom rewrite anything.
HOUR_REST_MS, DAY_REST_MS = 600_000, 36 * 3_600_000
# In an event or a queue message of the archive's function: what to do.
TASK = "archive"
DUE, SWEEP, ARCHIVE, JOIN, PUT_OFF = "due", "sweep", "hour", "day", "put off"
# With `SWEEP` of a topic: all its hours, not only those that expire soon.
ALL = "all"
HOUR_US = 3_600_000_000
# What the key of a batch begins with, and the time that none reaches.
_START, _NEVER_US = re.compile(r"[0-9]{16}"), 10**16
_HOUR = re.compile(r"\d{4}-\d\d-\d\dT\d\d")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
# The part of a batch's envelope that its hash covers.
_HASHED = tuple(name for name in ENVELOPE if name != BATCH)
# In an item that comes back from the archive: the hash of the item that was stored.
HASH = "_sha256"


class Hour(NamedTuple):
    """An hour of UTC, counted from the epoch."""

    number: int

    @property
    def start_us(self) -> int:
        return self.number * HOUR_US

    @property
    def end_us(self) -> int:
        """The first microsecond of the next hour."""
        return (self.number + 1) * HOUR_US

    @property
    def date(self) -> str:
        """Its day, such as 2026-11-22."""
        return str(self)[:10]

    def __str__(self) -> str:
        return f"{_EPOCH + timedelta(hours=self.number):%Y-%m-%dT%H}"


def hour_of(t_us: int) -> Hour:
    """The hour of a time."""
    return Hour(t_us // HOUR_US)


def parse_hour(name: str) -> Hour:
    """Parse an hour's text; raises `ContractError`."""
    checked(_HOUR, name, HOUR, "an hour such as 2026-11-22T07")
    try:
        since = datetime.strptime(name + "+0000", "%Y-%m-%dT%H%z") - _EPOCH
    except ValueError as error:
        raise ContractError(f"{HOUR} must be an hour such as 2026-11-22T07, got {name}") from error
    return Hour(since // timedelta(hours=1))


def hour_key(topic: Topic, hour: Hour) -> str:
    """The object of an hour."""
    return f"{_day(topic, hour)}{str(hour)[-2:]}.parquet"


def day_key(topic: Topic, hour: Hour) -> str:
    """The object of an hour's day."""
    return f"{_day(topic, hour)}day.parquet"


def refused_key(topic: Topic, hour: Hour) -> str:
    """The object of an hour's stored items that are not batches: DynamoDB's JSON, a line each. Athena and
    Spark skip names with an underscore in front."""
    return f"{_day(topic, hour)}_{str(hour)[-2:]}.refused.jsonl"


def _day(topic: Topic, hour: Hour) -> str:
    return f"{ARCHIVE_PREFIX}robot={topic.robot}/stream={topic.name}/date={hour.date}/"


@dataclass(frozen=True)
class ArchivedHour:
    """A row of the manifest: what an hour's object holds.

    The object ``key`` is the hour's or, once compacted, its day's; the file itself says which row groups are
    the hour's. ``content`` is `content_hash`, ``sha256`` and ``size_bytes`` are the object's. In
    ``first_expires_s`` the first of the hour's items leaves the telemetry table. An hour with refused items
    only has an empty ``key``.
    """

    topic: str
    hour: str
    key: str
    batches: int
    samples: int
    refused: int
    content: str
    sha256: str
    size_bytes: int
    archived_ms: int
    first_expires_s: int

    def item(self) -> Item:
        return {
            name: {"S": value} if isinstance(value, str) else {"N": str(value)}
            for name, value in vars(self).items()
        }


def archived_hour(item: Mapping[str, Any]) -> ArchivedHour:
    """Decode a row of the manifest, as DynamoDB sends it; raises `ContractError`."""
    return read(ArchivedHour, plain(item))


class ArchiveTable(TopicTable):
    """The archive's manifest, by topic and hour; and its pending rows."""

    def __init__(self, client: Any, name: str) -> None:
        super().__init__(client, name, HOUR)

    def row(self, topic: str, hour: Hour) -> ArchivedHour | None:
        """An hour's row; raises `ContractError` if it is damaged."""
        key = {TOPIC: {"S": topic}, HOUR: {"S": str(hour)}}
        answer = self._client.get_item(TableName=self.name, Key=key, ConsistentRead=True)
        return archived_hour(answer["Item"]) if "Item" in answer else None

    def keep(self, row: ArchivedHour, before: ArchivedHour | None) -> None:
        """Write a row, if the hour still has the content from before; raises the client's error if not."""
        unchanged: dict[str, Any] = {"ConditionExpression": "attribute_not_exists(content)"}
        if before is not None:
            unchanged = {
                "ConditionExpression": "content = :content",
                "ExpressionAttributeValues": {":content": {"S": before.content}},
            }
        self._client.put_item(TableName=self.name, Item=row.item(), **unchanged)

    def mark(self, pending: Pending, now_ms: int) -> int:
        """Mark what is to be done, or move its mark to a later time; returns when it is due."""
        due_ms = pending.due_ms(now_ms)
        # A row with a later time stays.
        self.change(
            pending,
            "SET #due = :due, #first = if_not_exists(#first, :due)",
            "attribute_not_exists(#due) OR #due < :due",
            due=due_ms,
        )
        return due_ms

    def change(self, pending: Pending, change: str, condition: str, **values: int) -> None:
        """Change a mark if the condition holds."""
        names = {"#due": DUE_MS, "#first": FIRST_DUE_MS}
        more: dict[str, Any] = {}
        if values:
            numbers = {f":{name}": {"N": str(value)} for name, value in values.items()}
            more["ExpressionAttributeValues"] = numbers
        with suppress(self._client.exceptions.ConditionalCheckFailedException):
            self._client.update_item(
                TableName=self.name,
                Key=pending.key,
                UpdateExpression=change,
                ConditionExpression=condition,
                ExpressionAttributeNames={k: v for k, v in names.items() if k in change + condition},
                **more,
            )


def hours_between(first: Hour | None, last: Hour | None) -> Keys:
    """The keys of hours between two, both inclusive; None is open."""
    low, high = ("0" if first is None else str(first)), ("9~" if last is None else str(last))
    return Keys({"S": low}, {"S": high}, low > high)


def stored_hours(table: TelemetryTable, topic: str, until_us: int | None, from_us: int = 0) -> Iterator[Hour]:
    """The hours of a topic that have stored items and are over by a time (None is open); a query each.

    A robot decides about its keys, so one may begin with no time. It is in no hour, and passed over.
    """
    while from_us < _NEVER_US:
        pages = table.pages(topic, starting_between(from_us, until_us), attributes=(BATCH,), page_items=1)
        starts = (item[BATCH]["S"][:16] for page in pages for item in page.items)
        start = next(filter(_START.fullmatch, starts), None)
        if start is None:
            return
        hour = hour_of(int(start))
        if until_us is not None and hour.end_us > until_us:
            return
        yield hour
        from_us = hour.end_us


def item_hash(item: Item) -> str:
    """The hash of a stored item's content: 16 hex digits. A batch that was sent twice keeps its hash."""
    if HASH in item:
        return str(item[HASH]["S"])
    content = json.dumps([item.get(name) for name in _HASHED], separators=(",", ":"), default=repr)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def content_hash(hashes: Iterable[tuple[str, str]]) -> str:
    """The hash of an hour: over its batches' ids and their hashes, in the order of the ids."""
    whole = hashlib.sha256()
    for batch, each in hashes:
        whole.update(f"{batch} {each}\n".encode("utf-8", "surrogatepass"))
    return whole.hexdigest()


class Pending(NamedTuple):
    """A pending row: a topic, and the hour or the date."""

    topic: str
    period: str

    @property
    def key(self) -> Item:
        """Its key in the manifest."""
        partition = PENDING[zlib.crc32(self.topic.encode()) % len(PENDING)]
        return {TOPIC: {"S": partition}, HOUR: {"S": f"{self.period}#{self.topic}"}}

    @property
    def is_day(self) -> bool:
        return len(self.period) == len("2026-11-22")

    def due_ms(self, now_ms: int) -> int:
        """When to do what is noted now: after the period's rest, and after batches that may still follow.

        Items of a car whose clock is ahead would expire before the hour comes, so they do not wait for it.
        """
        start_ms = parse_hour(f"{self.period}T00" if self.is_day else self.period).start_us // 1000
        hours, rest_ms = (24, DAY_REST_MS) if self.is_day else (1, HOUR_REST_MS)
        over_ms = start_ms + hours * HOUR_US // 1000 + rest_ms
        soon_ms = now_ms + HOUR_REST_MS
        return soon_ms if start_ms > now_ms + HOUR_US // 1000 else max(over_ms, soon_ms)


def parse_pending(item: Item) -> Pending:
    """Decode the key of a pending row; raises `ContractError`."""
    period, _, topic = text(plain(item), HOUR).partition("#")
    parse_hour(period if "T" in period else f"{period}T00")
    return Pending(topic, period)
