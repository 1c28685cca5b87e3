"""Puts messages from quarantine back, once the cause is gone, and deletes what has arrived."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.attributes import plain
from iort_contract.checks import COMPACT, json_object
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_item
from iort_contract.tables import (
    BATCH,
    BY_LATER,
    BY_RULE,
    BY_STREAM,
    ENTRY,
    ENVELOPE,
    LAST_MS,
    RECEIVED_MS,
    REPLAY,
    REPLAYS,
    TOPIC,
)
from iort_contract.topics import RECORD
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.operations.quarantine import Entry, key, load
from iort_station.recordings.old_batches import is_old, upgraded, upgraded_item

# One that failed so often is for a person to look at.
MAX_REPLAYS = 3
_AT_ONCE = 8
_CONFIRM_S = 30.0
_POLL_S = 0.2


class Fate(str, Enum):
    """What became of an entry."""

    REPLAYED = "replayed"
    WOULD = "would be replayed"
    FAILED = "failed again"
    REFUSED = "still refused"
    GIVEN_UP = "replayed too often"
    GONE = "gone meanwhile"
    NOT_FOR_REPLAY = "not for replay"


class Outcome(NamedTuple):
    """An entry's fate, and what there is to say of it."""

    entry: Entry
    fate: Fate
    detail: str = ""


class _NotForReplayError(StationError):
    """An entry that has no batch in it."""


def replay(
    cloud: Cloud, entries: Sequence[Entry], *, dry_run: bool = False, again: bool = False
) -> Iterator[Outcome]:
    """Put each entry back, eight at a time; what became of them, in the order in which they end.

    A message of the record lane that a rule's action failed on is published to that rule again, and has
    arrived when the table holds its batch. One that Lambda 2 failed on or refused is given to Lambda 2
    again, which answers. Only then is the entry deleted. Every attempt is counted first, and after
    `MAX_REPLAYS` (unless ``again``) there are no more. Live messages, pings and events are of their
    moment and are not replayed. What was put off
    waits once more. A batch of version 1 goes back as one of this version: its agent had not
    been updated when the stacks were.
    """
    one = partial(_outcome, cloud, dry_run=dry_run, again=again)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        yield from pool.map(one, entries)


def _outcome(cloud: Cloud, listed: Entry, *, dry_run: bool, again: bool) -> Outcome:
    entry = load(cloud, listed)
    if entry is None:
        return Outcome(listed, Fate.GONE)
    current, batch = entry, None
    try:
        _check_kind(entry)
        if entry.source != BY_LATER:
            current = _current(entry)
            batch = _batch(current)
    except _NotForReplayError as error:
        return Outcome(listed, Fate.NOT_FOR_REPLAY, str(error))
    except ContractError as error:
        return Outcome(listed, Fate.REFUSED, str(error))
    if entry.replays >= MAX_REPLAYS and not again:
        return Outcome(entry, Fate.GIVEN_UP, f"{entry.replays} times")
    if dry_run:
        return Outcome(entry, Fate.WOULD)
    try:
        _count(cloud, entry)
        if batch is None:
            problem = _put_off(cloud, entry)
        elif _is_rules(entry):
            problem = _publish(cloud, current, batch)
        elif current is not entry and not _stored(cloud, entry.topic, batch):
            # Lambda 2 reads the table, and would find nothing to summarise.
            problem = "it is in the old telemetry table: `iort adopt` comes first"
        else:
            problem = _summarize(cloud, current)
        if problem:
            return Outcome(entry, Fate.FAILED, problem)
        _delete(cloud, entry)
    except (BotoCoreError, ClientError) as error:
        return Outcome(entry, Fate.FAILED, str(error))
    return Outcome(entry, Fate.REPLAYED)


def _is_rules(entry: Entry) -> bool:
    return entry.source.startswith(f"{BY_RULE} ")


def _check_kind(entry: Entry) -> None:
    if entry.source in (BY_STREAM, BY_LATER) and entry.topic:
        return
    if not _is_rules(entry) or not entry.topic.startswith(f"{RECORD}/"):
        raise _NotForReplayError("of its moment, or without a batch: only the record lane is replayed")


def _current(entry: Entry) -> Entry:
    """The entry as it is, or with a batch of this version where it has one of version 1; raises
    `ContractError` where it has none of either."""
    # An item that did not fit into the quarantine's was cut.
    value = json_object(entry.payload or b"", "message")
    if entry.source == BY_STREAM:
        new = upgraded_item(value) if is_old(plain(value)) else None
    else:
        new = upgraded(value) if is_old(value) else None
    if new is None:
        return entry
    try:
        return replace(entry, payload=COMPACT.encode(new).encode())
    except ValueError as error:  # 1e400 can be read, and not be written
        raise ContractError(f"message: {error}") from error


def _batch(entry: Entry) -> Batch:
    """The batch in an entry; raises `ContractError` where it is none."""
    value = json_object(entry.payload or b"", "message")
    if entry.source == BY_STREAM:
        return decode_item(plain(value))[1]
    item = {name: value[name] for name in ENVELOPE if name in value}
    return decode_item({**item, TOPIC: entry.topic, RECEIVED_MS: entry.first_ms})[1]


def _count(cloud: Cloud, entry: Entry) -> None:
    cloud.client("dynamodb").update_item(
        TableName=cloud.output("storage", "QuarantineTable"),
        Key=key(entry),
        UpdateExpression="ADD #replays :one",
        ConditionExpression="attribute_exists(#id)",
        ExpressionAttributeNames={"#replays": REPLAYS, "#id": ENTRY},
        ExpressionAttributeValues={":one": {"N": "1"}},
    )


def _publish(cloud: Cloud, entry: Entry, batch: Batch) -> str:
    """Publish to the rule and wait for the item; what went wrong, or nothing."""
    if _stored(cloud, entry.topic, batch):
        return ""
    rule = entry.source.removeprefix(f"{BY_RULE} ")
    cloud.client("iot-data").publish(topic=f"$aws/rules/{rule}/{entry.topic}", qos=1, payload=entry.payload)
    deadline = time.monotonic() + _CONFIRM_S
    while time.monotonic() < deadline:
        if _stored(cloud, entry.topic, batch):
            return ""
        now = load(cloud, entry)
        if now and now.seen > entry.seen:
            return now.reason
        threading.Event().wait(_POLL_S)
    return f"not in the telemetry table after {_CONFIRM_S:.0f} s"


def _put_off(cloud: Cloud, entry: Entry) -> str:
    """Have the batches that Lambda 2 put off wait once more: what fails comes back."""
    queue = cloud.output("processing", "PutOffQueue")
    body = (entry.payload or b"").decode()
    cloud.client("sqs").send_message(QueueUrl=queue, MessageBody=body, MessageGroupId=entry.robot)
    return ""


def _stored(cloud: Cloud, topic: str, batch: Batch) -> bool:
    answer = cloud.client("dynamodb").get_item(
        TableName=cloud.output("storage", "TelemetryTable"),
        Key={TOPIC: {"S": topic}, BATCH: {"S": str(batch.id)}},
        ProjectionExpression="#batch",
        ExpressionAttributeNames={"#batch": BATCH},
        ConsistentRead=True,
    )
    return "Item" in answer


def _summarize(cloud: Cloud, entry: Entry) -> str:
    """Give the item to Lambda 2; what went wrong, or nothing."""
    image: dict[str, Any] = json.loads(entry.payload or b"{}")
    try:
        said = summarize(cloud, [image], {REPLAY: True})
    except StationError as error:
        return str(error)
    return "Lambda 2 refuses it; is the current version deployed?" if said["batchItemFailures"] else ""


def summarize(cloud: Cloud, items: Sequence[Mapping[str, Any]], event: Mapping[str, Any]) -> dict[str, Any]:
    """Give stored items to Lambda 2, in an event that says what for; its answer.

    Raises `StationError` where it fails.
    """
    changes = [
        {
            "Keys": {name: item[name] for name in (TOPIC, BATCH)},
            "NewImage": item,
            "SequenceNumber": str(number),
        }
        for number, item in enumerate(items)
    ]
    records = [{"eventID": "replay", "eventName": "INSERT", "dynamodb": change} for change in changes]
    answer = cloud.client("lambda").invoke(
        FunctionName=cloud.output("processing", "SummarizeFunction"),
        Payload=json.dumps({**event, "Records": records}).encode(),
    )
    said = json.loads(answer["Payload"].read() or b"null")
    if "FunctionError" in answer:
        raise StationError(f"Lambda 2 failed: {said.get('errorMessage', said)}")
    return {"batchItemFailures": [], **said}


def _delete(cloud: Cloud, entry: Entry) -> None:
    """Delete the entry, unless the same message was refused once more meanwhile."""
    dynamodb = cloud.client("dynamodb")
    try:
        dynamodb.delete_item(
            TableName=cloud.output("storage", "QuarantineTable"),
            Key=key(entry),
            ConditionExpression="#last = :last",
            ExpressionAttributeNames={"#last": LAST_MS},
            ExpressionAttributeValues={":last": {"N": str(entry.last_ms)}},
        )
    except dynamodb.exceptions.ConditionalCheckFailedException:
        return
