"""The quarantine: dead letters in its table, and the queues before it."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract import tables
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.checks import json_object
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_item
from iort_contract.topics import RECORD, as_subscribed
from iort_station.cloud import Cloud, invoke
from iort_station.data.recorded import telemetry_table
from iort_station.errors import StationError

_HEADER = (
    tables.SOURCE,
    tables.TOPIC,
    tables.REASON,
    tables.FIRST_MS,
    tables.LAST_MS,
    tables.SEEN,
    tables.REPLAYS,
)
_LISTED = (tables.ROBOT, tables.ENTRY, *_HEADER)
# What goes when a dead letter is deleted.
CONTENTS = (*_HEADER, tables.PAYLOAD)


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
        "FilterExpression": f"#{tables.LAST_MS} >= :since",
        "ExpressionAttributeNames": names,
        "ExpressionAttributeValues": {":since": {"N": str(since_ms)}},
    }
    dynamodb = cloud.client("dynamodb")
    pages: Iterable[Mapping[str, Any]]
    if robot is None:
        pages = dynamodb.get_paginator("scan").paginate(**request)
    else:
        request["KeyConditionExpression"] = f"#{tables.ROBOT} = :robot"
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
    return _letter(answer["Item"]) if tables.LAST_MS in answer.get("Item", ()) else None


def key(letter: DeadLetter) -> dict[str, Any]:
    """The dead letter's key in the table."""
    return {tables.ROBOT: {"S": letter.robot}, tables.ENTRY: {"S": letter.id}}


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
    source = values.get(tables.SOURCE, "")
    return DeadLetter(
        robot=values[tables.ROBOT],
        id=values[tables.ENTRY],
        source=source,
        topic=as_subscribed(values.get(tables.TOPIC, ""), source.removeprefix(f"{tables.BY_RULE} ")),
        reason=values.get(tables.REASON, ""),
        first_ms=int(values.get(tables.FIRST_MS, 0)),
        last_ms=int(values.get(tables.LAST_MS, 0)),
        seen=int(values.get(tables.SEEN, 0)),
        replays=int(values.get(tables.REPLAYS, 0)),
        payload=bytes(values[tables.PAYLOAD]) if tables.PAYLOAD in values else None,
    )


# Replays dead letters from the quarantine, and deletes those that have arrived.

# After this many attempts a person must look at it.
MAX_REPLAYS = 3
_AT_ONCE = 8
_CONFIRM_S = 30.0
_POLL_S = 0.2


class Fate(str, Enum):
    """The result of a replay."""

    REPLAYED = "replayed"
    WOULD = "would be replayed"
    FAILED = "failed again"
    REFUSED = "still refused"
    GIVEN_UP = "replayed too often"
    GONE = "no longer there"
    NOT_FOR_REPLAY = "not replayable"


class Outcome(NamedTuple):
    """A dead letter, its result, and an explanation."""

    letter: DeadLetter
    fate: Fate
    detail: str = ""


class _NotForReplayError(StationError):
    """A dead letter that holds no batch."""


def replay(
    cloud: Cloud, letters: Sequence[DeadLetter], *, dry_run: bool = False, again: bool = False
) -> Iterator[Outcome]:
    """Replay dead letters, eight at a time.

    A record message whose rule failed is published to that rule again; it has arrived when the table holds
    its batch. A batch that Lambda 2 refused is given to Lambda 2 again. Then the dead letter is deleted.
    Each attempt is counted; after `MAX_REPLAYS` there are no more, unless ``again``. Live messages, pings and
    events are outdated and are not replayed. Batches that were put off go back to their queue. An incident of
    which nobody could be told is told again.
    """
    one = partial(_outcome, cloud, dry_run=dry_run, again=again)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        yield from pool.map(one, letters)


def _outcome(cloud: Cloud, listed: DeadLetter, *, dry_run: bool, again: bool) -> Outcome:
    letter = load(cloud, listed)
    if letter is None:
        return Outcome(listed, Fate.GONE)
    batch = None
    try:
        _check_kind(letter)
        if letter.source != tables.BY_LATER and not _is_incident(letter):
            batch = _batch(letter)
    except _NotForReplayError as error:
        return Outcome(listed, Fate.NOT_FOR_REPLAY, str(error))
    except ContractError as error:
        return Outcome(listed, Fate.REFUSED, str(error))
    if letter.replays >= MAX_REPLAYS and not again:
        return Outcome(letter, Fate.GIVEN_UP, f"{letter.replays} times")
    if dry_run:
        return Outcome(letter, Fate.WOULD)
    try:
        _count(cloud, letter)
        if _is_incident(letter):
            problem = _told(cloud, letter)
        elif batch is None:
            problem = _put_off(cloud, letter)
        elif _is_rules(letter):
            problem = _publish(cloud, letter, batch)
        else:
            problem = _summarize(cloud, letter)
        if problem:
            return Outcome(letter, Fate.FAILED, problem)
        _delete(cloud, letter)
    except (BotoCoreError, ClientError) as error:
        return Outcome(letter, Fate.FAILED, str(error))
    return Outcome(letter, Fate.REPLAYED)


def _is_rules(letter: DeadLetter) -> bool:
    return letter.source.startswith(f"{tables.BY_RULE} ")


def _is_incident(letter: DeadLetter) -> bool:
    levels = letter.topic.split("/")
    named = (levels[0], levels[-1]) == (RECORD, INCIDENT_STREAM)
    return named and letter.source.startswith(f"{tables.BY_FUNCTION} ")


def _check_kind(letter: DeadLetter) -> None:
    if (letter.source in (tables.BY_STREAM, tables.BY_LATER) and letter.topic) or _is_incident(letter):
        return
    if not _is_rules(letter) or not letter.topic.startswith(f"{RECORD}/"):
        raise _NotForReplayError("only batches of the record lane, and incidents, are replayed")


def _batch(letter: DeadLetter) -> Batch:
    """The batch in a dead letter; raises `ContractError`."""
    # The quarantine cuts items that are too large for it.
    value = json_object(letter.payload or b"", "message")
    if letter.source == tables.BY_STREAM:
        return decode_item(plain(value))[1]
    item = {name: value[name] for name in tables.ENVELOPE if name in value}
    return decode_item({**item, tables.TOPIC: letter.topic, tables.RECEIVED_MS: letter.first_ms})[1]


def _count(cloud: Cloud, letter: DeadLetter) -> None:
    cloud.client("dynamodb").update_item(
        TableName=cloud.output("storage", "QuarantineTable"),
        Key=key(letter),
        UpdateExpression="ADD #replays :one",
        ConditionExpression="attribute_exists(#last)",
        ExpressionAttributeNames={"#replays": tables.REPLAYS, "#last": tables.LAST_MS},
        ExpressionAttributeValues={":one": {"N": "1"}},
    )


def _publish(cloud: Cloud, letter: DeadLetter, batch: Batch) -> str:
    """Publish to the rule and wait for the stored batch; returns the error, or nothing."""
    if _stored(cloud, letter.topic, batch):
        return ""
    rule = letter.source.removeprefix(f"{tables.BY_RULE} ")
    topic = f"$aws/rules/{rule}/{letter.topic}"
    cloud.client("iot-data").publish(topic=topic, qos=1, payload=letter.payload or b"")
    deadline = time.monotonic() + _CONFIRM_S
    while time.monotonic() < deadline:
        if _stored(cloud, letter.topic, batch):
            return ""
        now = load(cloud, letter)
        if now and now.seen > letter.seen:
            return now.reason
        threading.Event().wait(_POLL_S)
    return f"not in the telemetry table after {_CONFIRM_S:.0f} s"


def _put_off(cloud: Cloud, letter: DeadLetter) -> str:
    """Send batches that Lambda 2 put off to their queue again; returns the error, or nothing."""
    queue = cloud.output("processing", "PutOffQueue")
    body = (letter.payload or b"").decode()
    cloud.client("sqs").send_message(QueueUrl=queue, MessageBody=body, MessageGroupId=letter.robot)
    return ""


def _told(cloud: Cloud, letter: DeadLetter) -> str:
    """Have an incident told; returns the error, or nothing."""
    try:
        invoke(cloud, "processing", "IncidentFunction", letter.payload or b"{}", "the function incident")
    except StationError as error:
        return str(error)
    return ""


def _stored(cloud: Cloud, topic: str, batch: Batch) -> bool:
    return telemetry_table(cloud).get(topic, str(batch.id), attributes=(tables.BATCH,)) is not None


def _summarize(cloud: Cloud, letter: DeadLetter) -> str:
    """Give the item to Lambda 2; returns the error, or nothing."""
    image: dict[str, Any] = json.loads(letter.payload or b"{}")
    try:
        said = summarize(cloud, [image], {tables.REPLAY: True})
    except StationError as error:
        return str(error)
    return "Lambda 2 refuses it; is the current version deployed?" if said["batchItemFailures"] else ""


def summarize(cloud: Cloud, items: Sequence[Mapping[str, Any]], event: Mapping[str, Any]) -> dict[str, Any]:
    """Invoke Lambda 2 with stored items and the further entries of ``event``; returns its answer.

    Raises `StationError` if it fails.
    """
    changes = [
        {
            "Keys": {name: item[name] for name in (tables.TOPIC, tables.BATCH)},
            "NewImage": item,
            "SequenceNumber": str(number),
        }
        for number, item in enumerate(items)
    ]
    records = [{"eventID": "replay", "eventName": "INSERT", "dynamodb": change} for change in changes]
    payload = json.dumps({**event, "Records": records}).encode()
    answer = invoke(cloud, "processing", "SummarizeFunction", payload, "Lambda 2")
    return {"batchItemFailures": [], **(json.loads(answer or b"null") or {})}


def _delete(cloud: Cloud, letter: DeadLetter) -> None:
    """Delete the dead letter, unless the same message was refused again in the meantime.

    Its id stays until it would have expired: a further move must not bring it back.
    """
    dynamodb = cloud.client("dynamodb")
    try:
        dynamodb.update_item(
            TableName=cloud.output("storage", "QuarantineTable"),
            Key=key(letter),
            UpdateExpression="REMOVE " + ", ".join(f"#{name}" for name in CONTENTS),
            ConditionExpression=f"#{tables.LAST_MS} = :last",
            ExpressionAttributeNames={f"#{name}": name for name in CONTENTS},
            ExpressionAttributeValues={":last": {"N": str(letter.last_ms)}},
        )
    except dynamodb.exceptions.ConditionalCheckFailedException:
        return
