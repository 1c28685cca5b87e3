"""Sends many messages to an SQS queue in few calls, and what was refused to the quarantine's."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared import clients
from functions.shared.clients import variables
from iort_contract.catalog.environments import EchoEnvironment
from iort_contract.limits import ContractError
from iort_contract.tables import BATCH, ITEM_BASE64, REASON, TOPIC

if TYPE_CHECKING:
    from types_boto3_sqs import SQSClient


_log = logging.getLogger(__name__)
# SendMessageBatch: at most ten messages, of 256 KiB together.
_MESSAGES, _BYTES = 10, 256 * 1024


def send_all(client: SQSClient, queue_url: str, messages: Sequence[Mapping[str, Any]]) -> set[int]:
    """Send messages with the entries of SendMessageBatch; return the places of those that were not taken."""
    left: set[int] = set()
    for places in _calls(messages):
        entries: Any = [{"Id": str(place), **messages[place]} for place in places]
        try:
            failed = client.send_message_batch(QueueUrl=queue_url, Entries=entries).get("Failed", [])
        except (BotoCoreError, ClientError) as error:
            _log.warning("%d messages stay where they are: %s", len(places), error)
            left |= set(places)
            continue
        for entry in failed:
            _log.warning("a message stays where it is: %s", entry.get("Code"))
            left.add(int(entry["Id"]))
    return left


def _calls(messages: Sequence[Mapping[str, Any]]) -> Iterator[list[int]]:
    places: list[int] = []
    size = 0
    for place, message in enumerate(messages):
        bytes_ = len(message["MessageBody"])
        if places and (len(places) == _MESSAGES or size + bytes_ > _BYTES):
            yield places
            places, size = [], 0
        places.append(place)
        size += bytes_
    if places:
        yield places


# The limit of a single message.
_MOST_BYTES = 1024 * 1024


class Refused(NamedTuple):
    """A stream record that cannot be decoded: its sequence number, the reason, and the item as DynamoDB
    JSON."""

    number: str
    reason: str
    image: Mapping[str, Any]


class DeadLetterQueue:
    """Sends refused messages to the quarantine's queue."""

    def __init__(self, client: SQSClient, queue_url: str) -> None:
        self._client, self._queue_url = client, queue_url

    def refuse(self, refused: Sequence[Refused]) -> list[Refused]:
        """Send each record; return those that the queue did not take."""
        messages = [{"MessageBody": message(one)} for one in refused]
        return [refused[place] for place in sorted(send_all(self._client, self._queue_url, messages))]


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


def quarantined(serve: Callable[[Any], None]) -> Callable[[Any, Any], None]:
    """A handler of a rule's events. What ``serve`` refuses by `ContractError` goes to the quarantine.

    The invocation does not fail then, since a failure may cost the environment, and the next event waits for
    another one. It fails if the queue does not take the event: Lambda then sends it to the same queue.
    """

    @wraps(serve)
    def called(event: Any, context: Any) -> None:
        try:
            serve(event)
        except ContractError as error:
            topic = event.get(TOPIC) if isinstance(event, Mapping) else None
            _log.warning("refused a message of %r: %s", topic, error)
            # The form of Lambda's record of a failed invocation: "Destination event format".
            record = {
                "requestContext": {"functionArn": context.invoked_function_arn, "condition": "Refused"},
                "requestPayload": event,
                "responsePayload": {"errorMessage": str(error)[:1000]},
            }
            queue_url = variables(EchoEnvironment).rejected_queue
            try:
                clients.sqs(at_once=True).send_message(QueueUrl=queue_url, MessageBody=json.dumps(record))
            except (BotoCoreError, ClientError) as failure:
                _log.warning("the queue did not take a refused message: %s", failure)
                raise error from failure

    return called


def _body(reason: str, item: Mapping[str, Any]) -> str:
    text = json.dumps(item, separators=(",", ":"), ensure_ascii=False)
    encoded = base64.b64encode(text.encode("utf-8", "surrogatepass")).decode()
    return json.dumps({REASON: reason[:1000], ITEM_BASE64: encoded})
