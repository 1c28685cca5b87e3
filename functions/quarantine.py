"""Quarantine: moves messages that rules, streams and functions could not process from a queue into a table.

A queue cannot be listed and forgets after 14 days. The table keeps every message with its bytes, its reason
and its count, for `iort errors` and `iort replay-errors`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import connect, variables
from functions.shared.metrics import emit
from functions.shared.share import waiting
from iort_contract import tables
from iort_contract.archive import HOUR, TASK
from iort_contract.catalog.environments import QuarantineEnvironment
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import event_message
from iort_contract.tables import BY_FUNCTION, BY_LATER, BY_RULE, BY_STREAM, ENTRY, ITEM_BASE64, ROBOT, TOPIC
from iort_contract.topics import LANES, as_subscribed

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_dynamodbstreams import DynamoDBStreamsClient

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)
_REASON_CHARACTERS = 2_000
# An item holds 400 KB; an item of the telemetry table can be larger as JSON.
_MAX_PAYLOAD_BYTES = 360 * 1024
# "GetRecords": an empty answer does not mean the end. This is the number of empty answers to skip.
_EMPTY_ANSWERS = 50

Records = Callable[[Mapping[str, Any]], Iterable[Mapping[str, Any]]]


@dataclass(frozen=True)
class Entry:
    """A message to keep: its source, its topic ("" if unknown), the reason, and its bytes."""

    source: str
    topic: str
    reason: str
    payload: bytes

    @property
    def robot(self) -> str:
        """The robot in the topic; `iort_contract.NO_ROBOT` if the topic names no robot."""
        levels = self.topic.split("/")
        return levels[2] if len(levels) >= 3 and levels[0] in LANES and levels[2] else tables.NO_ROBOT

    @property
    def id(self) -> str:
        """The same id for the same message from the same source, however often it comes."""
        head = f"{self.source}\0{self.topic}\0".encode("utf-8", "surrogatepass")
        return hashlib.sha256(head + self.payload).hexdigest()[:16]


def entries(body: str, records: Records) -> list[Entry]:
    """The quarantined messages in one queue message.

    The queue message is a rule's error document, a record that `summarize` refused, a failed asynchronous
    invocation, a failed batch of the stream (``records`` fetches its records), or the keys of put-off batches
    that failed. Any other message is kept as it is.
    """
    try:
        document = json.loads(body)
        if "base64OriginalPayload" in document:
            return [_of_rule(document)]
        if ITEM_BASE64 in document:
            item = base64.b64decode(document[ITEM_BASE64], validate=True)
            return [_of_item(document[tables.REASON], item)]
        if "DDBStreamBatchInfo" in document:
            condition = str(document["requestContext"]["condition"])
            found = [
                _of_item(f"Lambda 2 failed: {condition}", _json(record["dynamodb"]["NewImage"]))
                for record in records(document["DDBStreamBatchInfo"])
                if "NewImage" in record["dynamodb"]
            ]
            return found or [
                Entry(BY_STREAM, "", f"{condition}; the records have left the stream", body.encode())
            ]
        if "requestPayload" in document:
            return [_of_invocation(document)]
        if TASK in document:
            about = f"{document[TASK]} {document.get(HOUR, '')}".strip()
            reason = f"the archive failed in five attempts: {about}"
            return [Entry(BY_FUNCTION, str(document.get(TOPIC, "")), reason, body.encode())]
        if tables.PUT_OFF in document:
            topic, _ = waiting(body)[0]
            return [Entry(BY_LATER, topic, "put off, and not summarised in five attempts", body.encode())]
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, binascii.Error) as error:
        reason = f"a message that the quarantine does not know: {type(error).__name__}: {error}"
    else:
        reason = "a message that the quarantine does not know"
    return [Entry(BY_FUNCTION, "", reason, body.encode("utf-8", "surrogatepass"))]


def _of_rule(document: Mapping[str, Any]) -> Entry:
    failures = document.get("failures") or []
    reason = "; ".join(f"{f.get('failedAction')}: {f.get('errorMessage')}" for f in failures)
    rule = str(document["ruleName"])
    return Entry(
        source=f"{BY_RULE} {rule}",
        topic=as_subscribed(str(document.get("topic", "")), rule),
        reason=reason or "no reason given",
        payload=base64.b64decode(document["base64OriginalPayload"], validate=True),
    )


def _of_item(reason: str, item: bytes) -> Entry:
    topic = json.loads(item).get(TOPIC, {}).get("S", "")
    return Entry(BY_STREAM, topic, reason, item)


def _of_invocation(document: Mapping[str, Any]) -> Entry:
    context, event = document["requestContext"], document["requestPayload"]
    name = str(context.get("functionArn", "")).split(":function:")[-1].split(":")[0]
    said = document.get("responsePayload")
    error = said.get("errorMessage") if isinstance(said, dict) else said
    topic = event.get(TOPIC) if isinstance(event, dict) else None
    return Entry(
        source=f"{BY_FUNCTION} {name}",
        topic=topic if isinstance(topic, str) else "",
        reason=f"{context.get('condition')}: {error}",
        payload=_message(event),
    )


def _message(event: Any) -> bytes:
    """The bytes of the message that a function was called with, or else the event."""
    with suppress(ContractError, AttributeError):
        return event_message(event)
    return _json(event)


def _json(value: Any) -> bytes:
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, default=_binary)
    return text.encode("utf-8", "surrogatepass")


def _binary(value: Any) -> str:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    raise TypeError(type(value).__name__)


class Store:
    """The quarantine table."""

    def __init__(self, client: DynamoDBClient, *, table: str, retention_s: int) -> None:
        self._client, self._table, self._retention_s = client, table, retention_s

    def put(self, entry: Entry, sent_ms: int) -> None:
        """Keep the message; a repeated message only raises its count. A message too large for an item is cut:
        its full item is in the telemetry table."""
        payload, reason = entry.payload, _unicode(entry.reason[:_REASON_CHARACTERS])
        if len(payload) > _MAX_PAYLOAD_BYTES:
            payload = payload[:_MAX_PAYLOAD_BYTES]
            reason = f"cut from {len(entry.payload)} bytes; {reason}"
        sent = {"N": str(sent_ms)}
        attributes: dict[str, dict[str, Any]] = {
            tables.SOURCE: {"S": entry.source},
            TOPIC: {"S": _unicode(entry.topic)},
            tables.REASON: {"S": reason},
            tables.PAYLOAD: {"B": payload},
            tables.LAST_MS: sent,
            tables.EXPIRES_S: {"N": str(sent_ms // 1000 + self._retention_s)},
        }
        self._client.update_item(
            TableName=self._table,
            Key={ROBOT: {"S": _unicode(entry.robot)}, ENTRY: {"S": entry.id}},
            UpdateExpression=(
                f"SET {', '.join(f'#{name} = :{name}' for name in attributes)},"
                f" #{tables.FIRST_MS} = if_not_exists(#{tables.FIRST_MS}, :{tables.LAST_MS})"
                f" ADD #{tables.SEEN} :one"
            ),
            # Some are reserved words.
            ExpressionAttributeNames={
                f"#{name}": name for name in (*attributes, tables.FIRST_MS, tables.SEEN)
            },
            ExpressionAttributeValues={
                ":one": {"N": "1"},
                **{f":{name}": value for name, value in attributes.items()},
            },
        )


def _unicode(text: str) -> str:
    """The text with lone surrogates escaped; JSON may hold them, but no table takes them."""
    return text.encode("utf-8", "backslashreplace").decode()


class StreamError(Exception):
    """The stream did not return a failed batch's records within the allowed calls; try again."""


class Stream:
    """Reads records from the telemetry table's stream."""

    def __init__(self, client: DynamoDBStreamsClient) -> None:
        self._client = client

    def records(self, info: Mapping[str, Any]) -> list[Mapping[str, Any]]:
        """The records of a failed batch (``DDBStreamBatchInfo``); empty if they have left the stream.

        Raises `StreamError` if the last record was not reached, because a part would look like the whole
        batch.
        """
        last = int(info["endSequenceNumber"])
        found: list[Mapping[str, Any]] = []
        empty = 0
        try:
            iterator: str | None = self._client.get_shard_iterator(
                StreamArn=info["streamArn"],
                ShardId=info["shardId"],
                ShardIteratorType="AT_SEQUENCE_NUMBER",
                SequenceNumber=str(info["startSequenceNumber"]),
            )["ShardIterator"]
            while iterator and empty < _EMPTY_ANSWERS:
                answer = self._client.get_records(ShardIterator=iterator)
                for record in answer["Records"]:
                    number = int(record["dynamodb"]["SequenceNumber"])
                    if number <= last:
                        found.append(record)
                    if number >= last:
                        return found
                empty += not answer["Records"]
                iterator = answer.get("NextShardIterator")
        except self._client.exceptions.TrimmedDataAccessException:
            _log.warning("the records of a failed batch have left the stream: %s", info)
            return []
        raise StreamError(f"found {len(found)} records, but not the last one, of {info}")


def process(event: Mapping[str, Any], store: Store, records: Records) -> dict[str, Any]:
    """Keep the queue's messages; the answer names the messages to deliver again."""
    failed, kept = [], 0
    for message in event["Records"]:
        sent_ms = int(message.get("attributes", {}).get("SentTimestamp") or time.time() * 1000)
        try:
            for entry in entries(message["body"], records):
                store.put(entry, sent_ms)
                kept += 1
        except (BotoCoreError, ClientError, StreamError) as error:
            _log.warning("message %s comes again: %s", message["messageId"], error)
            failed.append(message["messageId"])
        except Exception:  # noqa: BLE001 - whatever one message does, its neighbours are kept
            _log.exception("message %s cannot be kept", message["messageId"])
            failed.append(message["messageId"])
    emit("quarantine", Quarantined=kept)
    return {"batchItemFailures": [{"itemIdentifier": number} for number in failed]}


def handler(event: dict[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the rejected queue's mapping."""
    given = variables(QuarantineEnvironment)
    store = Store(clients.dynamodb(), table=given.quarantine_table, retention_s=given.retention_s)
    return process(event, store, lambda info: Stream(connect("dynamodbstreams")).records(info))
