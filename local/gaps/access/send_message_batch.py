"""The permission for SendMessageBatch.

AWS: asks for sqs:SendMessage
  (https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-api-permissions-reference.html).
ministack: asks for sqs:SendMessageBatch, an action that AWS does not have.
Test: tests/local/test_gaps.py::test_a_batch_is_sent_with_the_permission_for_one_message
Patch: local/patches/send_message_batch.patch
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.core import iam_actions

_REQUEST: tuple[Any, ...] = ("sqs", "POST", "/", {"x-amz-target": "AmazonSQS.SendMessageBatch"}, b"{}", {})


def install() -> None:
    """Close the gap in this process."""
    iam_actions.extract_iam_action = as_one_message(iam_actions.extract_iam_action)


def is_open() -> bool:
    """Ask for the action of a request."""
    return bool(iam_actions.extract_iam_action(*_REQUEST) != "sqs:SendMessage")


def as_one_message(iam_action: Callable[..., str | None]) -> Callable[..., str | None]:
    """The action of a request, for a batch that of one message."""

    @wraps(iam_action)
    def extract(*request: Any) -> str | None:
        action = iam_action(*request)
        return "sqs:SendMessage" if action == "sqs:SendMessageBatch" else action

    return extract
