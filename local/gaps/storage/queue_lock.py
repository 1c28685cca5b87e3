"""A queue loses no message.

AWS: keeps a message that it has accepted until it is deleted or expires
  (https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-message-metadata.html).
ministack: replaces a queue's list when it removes messages, while another thread appends to the old list
  without the lock: that message is lost. Here every function that changes a list takes the lock.
Test: tests/local/test_queue_gap.py::test_each_of_ten_thousand_messages_arrives_once
Patch: local/patches/queue_lock.patch
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar
from unittest.mock import MagicMock, patch

from ministack.core.responses import request_scope
from ministack.services import lambda_svc, sqs

_Call = TypeVar("_Call", bound=Callable[..., Any])
# Functions of sqs.py that change a queue's list or a message. ReceiveMessage itself is not one of them: it
# waits for messages between its steps.
STEPS = (
    "_act_send_message",
    "_act_send_message_batch",
    "_act_delete_message",
    "_act_delete_message_batch",
    "_act_change_visibility",
    "_act_change_visibility_batch",
    "_act_purge_queue",
    "_expire_retained",
    "_dlq_sweep",
    "_collect_msgs",
)
# Functions of lambda_svc.py that append to a queue's list themselves.
DESTINATIONS = ("_route_async_failure", "_send_ddb_stream_failure_record")


def install() -> None:
    """Close the gap in this process."""
    # The functions call one another, and a plain lock cannot be taken twice.
    lock = sqs._queues_lock = threading.RLock()
    for module, names in ((sqs, STEPS), (lambda_svc, DESTINATIONS)):
        for name in names:
            _replace(module, name, locked(getattr(module, name), lock))


def is_open() -> bool:
    """Send a message, and look whether the lock was taken. (A test in test_queue_gap.py loses messages.)"""
    lock = MagicMock()
    with patch.object(sqs, "_queues_lock", lock), request_scope("000000000000", "eu-west-1"):
        url = sqs._act_create_queue({"QueueName": "gaps-queue-lock"}, "")["QueueUrl"]
        lock.reset_mock()
        sqs._HANDLERS["SendMessage"]({"MessageBody": "text"}, url)
        taken = lock.__enter__.called
        sqs._act_delete_queue({"QueueUrl": url}, "")
    return not taken


def _replace(module: Any, name: str, by: Callable[..., Any]) -> None:
    was = getattr(module, name)
    setattr(module, name, by)
    # Requests look the function up by their action.
    handlers = sqs._HANDLERS
    handlers.update({action: by for action, function in handlers.items() if function is was})


def locked(function: _Call, lock: Any) -> _Call:
    """The function, run under the lock."""

    @wraps(function)
    def alone(*arguments: Any, **named: Any) -> Any:
        with lock:
            return function(*arguments, **named)

    return alone  # type: ignore[return-value]  # of the same signature
