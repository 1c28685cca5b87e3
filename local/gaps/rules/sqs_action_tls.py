"""A rule's SQS action is a request over TLS.

AWS: services call each other over TLS, so aws:SecureTransport is true
  (https://docs.aws.amazon.com/IAM/latest/UserGuide/reference_policies_condition-keys.html).
ministack: takes the action for a request over plain HTTP, which the policies of our queues refuse.
Test: tests/local/test_quarantine.py::test_what_the_rule_cannot_store_is_kept_byte_by_byte
Patch: local/patches/sqs_action_tls.patch
"""

from __future__ import annotations

import contextvars
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest.mock import patch

from ministack.core import iam_evaluator
from ministack.services import iot, sqs


def install() -> None:
    """Close the gap in this process."""
    iot._dispatch_rule_sqs = _over_tls(iot._dispatch_rule_sqs)


def is_open() -> bool:
    """Run the action, and look at what the queue's policy would see."""
    secure = []

    def send(*_: Any) -> dict[str, str]:
        secure.append(iam_evaluator._request_origin.get()[1])
        return {"MessageId": ""}

    with patch.multiple(sqs, _get_q=lambda *_: {"is_fifo": False}, _act_send_message=send):
        arguments: tuple[Any, ...] = ("000000000000", "eu-west-1", "rule", {"queueUrl": "queue"}, {})
        contextvars.Context().run(iot._dispatch_rule_sqs, *arguments)
    return secure != [True]


def _over_tls(dispatch: Callable[..., None]) -> Callable[..., None]:
    @wraps(dispatch)
    def dispatch_rule_sqs(*arguments: Any) -> None:
        context = contextvars.copy_context()
        context.run(iam_evaluator.pin_request_origin, "127.0.0.1", True)
        context.run(dispatch, *arguments)

    return dispatch_rule_sqs
