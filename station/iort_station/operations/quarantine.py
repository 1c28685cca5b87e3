"""What was refused, as the quarantine table keeps it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from iort_contract.attributes import plain
from iort_contract.tables import (
    BY_RULE,
    ENTRY,
    FIRST_MS,
    LAST_MS,
    PAYLOAD,
    REASON,
    REPLAYS,
    ROBOT,
    SEEN,
    SOURCE,
    TOPIC,
)
from iort_contract.topics import as_subscribed
from iort_station.cloud import Cloud
from iort_station.errors import StationError

_LISTED = (ROBOT, ENTRY, SOURCE, TOPIC, REASON, FIRST_MS, LAST_MS, SEEN, REPLAYS)


@dataclass(frozen=True)
class Entry:
    """A message in quarantine. ``source`` says where it was refused (`BY_RULE` and its like),
    ``first_ms`` and ``last_ms`` when, ``seen`` how often; ``payload`` is None in a list."""

    robot: str
    id: str
    source: str
    topic: str
    reason: str
    first_ms: int
    last_ms: int
    seen: int
    replays: int
    payload: bytes | None = None


@dataclass(frozen=True)
class Waiting:
    """Messages in the queues: on the way into the table, and those that it did not take."""

    rejected: int
    last: int


def entries(cloud: Cloud, *, robot: str | None = None, since_ms: int = 0) -> Iterator[Entry]:
    """What came last at ``since_ms`` or later, without the bytes; of all robots in no order."""
    names = {f"#{name}": name for name in _LISTED}
    request: dict[str, Any] = {
        "TableName": cloud.output("storage", "QuarantineTable"),
        "ProjectionExpression": ", ".join(names),
        "FilterExpression": f"#{LAST_MS} >= :since",
        "ExpressionAttributeNames": names,
        "ExpressionAttributeValues": {":since": {"N": str(since_ms)}},
    }
    operation = "scan"
    if robot is not None:
        operation = "query"
        request["KeyConditionExpression"] = f"#{ROBOT} = :robot"
        request["ExpressionAttributeValues"][":robot"] = {"S": robot}
    for page in cloud.client("dynamodb").get_paginator(operation).paginate(**request):
        yield from map(_entry, page["Items"])


def find(cloud: Cloud, entry_id: str) -> Entry:
    """The entry with its bytes; raises `StationError` where there is none, or no longer."""
    for entry in entries(cloud):
        if entry.id == entry_id and (loaded := load(cloud, entry)):
            return loaded
    raise StationError(f"nothing in quarantine has the id {entry_id}; `iort errors` lists what there is")


def load(cloud: Cloud, entry: Entry) -> Entry | None:
    """The entry as it is now, with its bytes; None where it is gone."""
    answer = cloud.client("dynamodb").get_item(
        TableName=cloud.output("storage", "QuarantineTable"), Key=key(entry), ConsistentRead=True
    )
    return _entry(answer["Item"]) if "Item" in answer else None


def key(entry: Entry) -> dict[str, Any]:
    """The entry's key in the table."""
    return {ROBOT: {"S": entry.robot}, ENTRY: {"S": entry.id}}


def waiting(cloud: Cloud) -> Waiting:
    """What the queues hold, about."""
    return Waiting(rejected=_depth(cloud, "RejectedQueue"), last=_depth(cloud, "LastQueue"))


def recover(cloud: Cloud) -> int:
    """Give what the table did not take to it once more; how many messages that were.

    A message is sent before it is deleted, so that none can be lost between the queues; one that is
    moved twice is the same entry.
    """
    sqs, moved = cloud.client("sqs"), 0
    last, rejected = cloud.output("quarantine", "LastQueue"), cloud.output("quarantine", "RejectedQueue")
    while messages := sqs.receive_message(QueueUrl=last, MaxNumberOfMessages=10).get("Messages", []):
        for message in messages:
            sqs.send_message(QueueUrl=rejected, MessageBody=message["Body"])
            sqs.delete_message(QueueUrl=last, ReceiptHandle=message["ReceiptHandle"])
            moved += 1
    return moved


def _depth(cloud: Cloud, queue: str) -> int:
    names = ["ApproximateNumberOfMessages", "ApproximateNumberOfMessagesNotVisible"]
    answer = cloud.client("sqs").get_queue_attributes(
        QueueUrl=cloud.output("quarantine", queue), AttributeNames=names
    )
    return sum(int(answer["Attributes"][name]) for name in names)


def _entry(item: dict[str, Any]) -> Entry:
    values = plain(item)
    source = values.get(SOURCE, "")
    return Entry(
        robot=values[ROBOT],
        id=values[ENTRY],
        source=source,
        topic=as_subscribed(values.get(TOPIC, ""), source.removeprefix(f"{BY_RULE} ")),
        reason=values.get(REASON, ""),
        first_ms=int(values.get(FIRST_MS, 0)),
        last_ms=int(values.get(LAST_MS, 0)),
        seen=int(values.get(SEEN, 0)),
        replays=int(values.get(REPLAYS, 0)),
        payload=bytes(values[PAYLOAD]) if PAYLOAD in values else None,
    )
