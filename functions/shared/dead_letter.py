"""The adapter to the quarantine's queue, for messages that a function refuses."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import boto3
from botocore.config import Config
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.tables import BATCH, ITEM_BASE64, REASON, TOPIC

_log = logging.getLogger(__name__)
# SendMessageBatch: at most ten messages, of 256 KiB together.
_MESSAGES, _BYTES = 10, 256 * 1024
# The limit of a single message.
_MOST_BYTES = 1024 * 1024


class Refused(NamedTuple):
    """A stream record that cannot be decoded: its sequence number, the reason, and the item as DynamoDB
    JSON."""

    number: str
    reason: str
    image: Mapping[str, Any]


class DeadLetterQueue:
    """Sends refused records to the quarantine's queue; ``client`` is a boto3 SQS client."""

    def __init__(self, client: Any, *, queue_url: str) -> None:
        self._client, self._queue_url = client, queue_url

    @classmethod
    def at_once(cls, queue_url: str) -> DeadLetterQueue:
        """With a client that gives up quickly: if a function fails, Lambda sends the event to the queue
        itself."""
        config = Config(connect_timeout=2, read_timeout=5, retries={"total_max_attempts": 1})
        return cls(boto3.client("sqs", config=config), queue_url=queue_url)

    def refuse(self, refused: Sequence[Refused]) -> list[Refused]:
        """Send each record, in as few calls as possible; return those that the queue did not take."""
        return [one for several in _calls(refused) for one in self._left(several)]

    def keep(self, body: str) -> bool:
        """Send one body made by `message` or `refused_event`; return whether the queue took it."""
        try:
            self._client.send_message(QueueUrl=self._queue_url, MessageBody=body)
        except (BotoCoreError, ClientError) as error:
            _log.warning("the queue did not take a refused message: %s", error)
            return False
        return True

    def _left(self, several: Mapping[str, tuple[Refused, str]]) -> list[Refused]:
        entries = [{"Id": name, "MessageBody": body} for name, (_, body) in several.items()]
        try:
            answer = self._client.send_message_batch(QueueUrl=self._queue_url, Entries=entries)
        except (BotoCoreError, ClientError) as error:
            _log.warning("%d records stay in the stream: %s", len(several), error)
            return [one for one, _ in several.values()]
        failed = answer.get("Failed", [])
        for entry in failed:
            _log.warning("a record stays in the stream: %s", entry.get("Code"))
        return [several[entry["Id"]][0] for entry in failed]


def _calls(refused: Sequence[Refused]) -> Iterator[dict[str, tuple[Refused, str]]]:
    """Group the messages into calls, each message by an id."""
    several: dict[str, tuple[Refused, str]] = {}
    size = 0
    for number, one in enumerate(refused):
        body = message(one)
        if several and (len(several) == _MESSAGES or size + len(body) > _BYTES):
            yield several
            several, size = {}, 0
        several[str(number)] = (one, body)
        size += len(body)
    if several:
        yield several


def message(refused: Refused) -> str:
    """The queue's message. The item is in base64, since its text may hold characters that SQS refuses.

    An item too large as JSON (a number of four characters on the wire may have 126 digits there) is replaced
    by its key. A record that the queue never takes would block its shard.
    """
    body = _body(refused.reason, refused.image)
    if len(body) > _MOST_BYTES:
        key = {name: refused.image[name] for name in (TOPIC, BATCH) if name in refused.image}
        body = _body(f"too large for the queue, see the telemetry table; {refused.reason}", key)
    return body


def refused_event(function_arn: str, event: Any, reason: str) -> str:
    """The queue's message for an event that a function refused without failing.

    It has the form of Lambda's record of a failed invocation ("Destination event format")."""
    return json.dumps(
        {
            "requestContext": {"functionArn": function_arn, "condition": "Refused"},
            "requestPayload": event,
            "responsePayload": {"errorMessage": reason[:1000]},
        }
    )


def _body(reason: str, item: Mapping[str, Any]) -> str:
    text = json.dumps(item, separators=(",", ":"), ensure_ascii=False)
    encoded = base64.b64encode(text.encode("utf-8", "surrogatepass")).decode()
    return json.dumps({REASON: reason[:1000], ITEM_BASE64: encoded})
