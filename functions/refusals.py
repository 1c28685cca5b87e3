"""The adapter to the queue of what Lambda 2 refuses."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from contract import ITEM_BASE64, REASON

_log = logging.getLogger(__name__)


class Refused(NamedTuple):
    """A stream record that cannot be decoded: its sequence number, why, and the item as DynamoDB JSON."""

    number: str
    reason: str
    image: Mapping[str, Any]


class Refusals:
    """Sends refused records to the queue before the quarantine; ``client`` is a boto3 SQS client."""

    def __init__(self, client: Any, *, queue_url: str) -> None:
        self._client, self._queue_url = client, queue_url

    def refuse(self, refused: Sequence[Refused]) -> list[Refused]:
        """Send each; those that the queue did not take come back."""
        return [one for one in refused if not self._sent(one)]

    def _sent(self, refused: Refused) -> bool:
        try:
            self._client.send_message(QueueUrl=self._queue_url, MessageBody=message(refused))
        except (BotoCoreError, ClientError) as error:
            _log.warning("record %s stays in the stream: %s", refused.number, error)
            return False
        return True


def message(refused: Refused) -> str:
    """The queue's message. The item is in base64: its text may hold what SQS does not carry."""
    item = json.dumps(refused.image, separators=(",", ":"), ensure_ascii=False)
    return json.dumps(
        {
            REASON: refused.reason[:1000],
            ITEM_BASE64: base64.b64encode(item.encode("utf-8", "surrogatepass")).decode(),
        }
    )
