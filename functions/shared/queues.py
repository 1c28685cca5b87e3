"""Sends many messages to an SQS queue in few calls."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from botocore.exceptions import BotoCoreError, ClientError

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
