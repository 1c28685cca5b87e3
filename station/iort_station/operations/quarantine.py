"""The quarantine: dead letters in its table, and the queues before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from iort_contract.dynamodb import plain
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

_HEADER = (SOURCE, TOPIC, REASON, FIRST_MS, LAST_MS, SEEN, REPLAYS)
_LISTED = (ROBOT, ENTRY, *_HEADER)
# What goes when a dead letter is deleted.
CONTENTS = (*_HEADER, PAYLOAD)


@dataclass(frozen=True)
class DeadLetter:
    """A refused message. ``source`` says where it was refused (`iort_contract.BY_RULE` and others),
    ``first_ms`` and ``last_ms`` when, and ``seen`` how often. ``payload`` is None in a list."""

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
    """The number of messages on their way into the table, and of those that it refused."""

    rejected: int
    last: int


def entries(cloud: Cloud, *, robot: str | None = None, since_ms: int = 0) -> Iterator[DeadLetter]:
    """Dead letters last seen at ``since_ms`` or later, without payloads; in no order if of all robots."""
    names = {f"#{name}": name for name in _LISTED}
    request: dict[str, Any] = {
        "TableName": cloud.output("storage", "QuarantineTable"),
        "ProjectionExpression": ", ".join(names),
        "FilterExpression": f"#{LAST_MS} >= :since",
        "ExpressionAttributeNames": names,
        "ExpressionAttributeValues": {":since": {"N": str(since_ms)}},
    }
    dynamodb = cloud.client("dynamodb")
    pages: Iterable[Mapping[str, Any]]
    if robot is None:
        pages = dynamodb.get_paginator("scan").paginate(**request)
    else:
        request["KeyConditionExpression"] = f"#{ROBOT} = :robot"
        request["ExpressionAttributeValues"][":robot"] = {"S": robot}
        pages = dynamodb.get_paginator("query").paginate(**request)
    for page in pages:
        yield from map(_letter, page["Items"])


def find(cloud: Cloud, letter_id: str) -> DeadLetter:
    """A dead letter with its payload; raises `StationError` for an unknown id."""
    for letter in entries(cloud):
        if letter.id == letter_id and (loaded := load(cloud, letter)):
            return loaded
    raise StationError(f"no dead letter has the id {letter_id}; `iort errors` lists them")


def load(cloud: Cloud, letter: DeadLetter) -> DeadLetter | None:
    """The dead letter as it is now, with its payload; None if it was deleted."""
    answer = cloud.client("dynamodb").get_item(
        TableName=cloud.output("storage", "QuarantineTable"), Key=key(letter), ConsistentRead=True
    )
    return _letter(answer["Item"]) if LAST_MS in answer.get("Item", ()) else None


def key(letter: DeadLetter) -> dict[str, Any]:
    """The dead letter's key in the table."""
    return {ROBOT: {"S": letter.robot}, ENTRY: {"S": letter.id}}


def waiting(cloud: Cloud) -> Waiting:
    """The approximate number of messages in the queues."""
    return Waiting(rejected=_depth(cloud, "RejectedQueue"), last=_depth(cloud, "LastQueue"))


def recover(cloud: Cloud) -> int:
    """Send the messages that the table refused back to the first queue; returns their number.

    A message is sent before it is deleted, so none is lost; a message sent twice is the same dead letter.
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
    counts = cloud.client("sqs").get_queue_attributes(
        QueueUrl=cloud.output("quarantine", queue),
        AttributeNames=["ApproximateNumberOfMessages", "ApproximateNumberOfMessagesNotVisible"],
    )["Attributes"]
    return int(counts["ApproximateNumberOfMessages"]) + int(counts["ApproximateNumberOfMessagesNotVisible"])


def _letter(item: Mapping[str, Any]) -> DeadLetter:
    values = plain(item)
    source = values.get(SOURCE, "")
    return DeadLetter(
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
