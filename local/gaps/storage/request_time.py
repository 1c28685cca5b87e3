"""The time of a request to DynamoDB.

AWS: does not apply; what a request costs AWS does not show
  (https://docs.aws.amazon.com/amazondynamodb/latest/APIReference/API_BatchWriteItem.html).
ministack: parses the body of every request four times for IAM and once more to serve it, and goes through
  each item of a BatchWriteItem six times. A body of 25 summaries has 100 KB. Here a body is parsed once, an
  item is checked once, and capacity is counted where it is asked for.
Test: tests/local/gaps/test_time_gaps.py::test_a_batch_write_reads_its_items_once
Patch: none; it is about speed only, so that upstream should measure it with its own load
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextvars import ContextVar
from functools import wraps
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

from ministack.core import iam_actions
from ministack.services import dynamodb

_BODY = b'{"TableName": "gaps-request-time"}'
# The items that the running BatchWriteItem has found good, by their identity.
_GOOD: ContextVar[dict[int, Any] | None] = ContextVar("good", default=None)


class OneBody:
    """The body that was parsed last.

    The policy check reads its values; the service takes them away, since it stores items without a copy.
    """

    def __init__(self) -> None:
        self._body: bytes | None = None
        self._values: Any = None

    def read(self, text: str | bytes) -> Any:
        """The values of a body, which is parsed once."""
        if not isinstance(text, bytes):
            return json.loads(text)
        if text is not self._body:
            self._values, self._body = json.loads(text), text
        return self._values

    def take(self, text: str | bytes) -> Any:
        """The values of a body, for a caller that may change them."""
        if text is not self._body:
            return json.loads(text)
        values, self._values, self._body = self._values, None, None
        return values


def install() -> None:
    """Close the gap in this process."""
    body = OneBody()
    iam_actions.json = _reading(body.read)
    dynamodb.json = _reading(body.take)
    dynamodb._batch_write_item = _checking_once(dynamodb._batch_write_item)
    dynamodb._validate_item = _once(dynamodb._validate_item)
    dynamodb._accumulate_write_capacity = _unless_batch(dynamodb._accumulate_write_capacity)


def is_open() -> bool:
    """Read a request twice as the policy check does, and count how often it is parsed."""
    loads = Mock(side_effect=json.loads)
    with patch.object(iam_actions, "json", _reading(loads)):
        iam_actions.dynamodb_service_context(_BODY)
        iam_actions.dynamodb_resource_arns(_BODY, "eu-west-1", "000000000000")
    return loads.call_count > 1


def _reading(loads: Callable[..., Any]) -> SimpleNamespace:
    return SimpleNamespace(**{**vars(json), "loads": loads})


def _checking_once(batch_write: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(batch_write)
    def write(data: dict[str, Any]) -> Any:
        if data.get("ReturnConsumedCapacity", "NONE") != "NONE":
            return batch_write(data)
        token = _GOOD.set({})
        try:
            return batch_write(data)
        finally:
            _GOOD.reset(token)

    return write


def _once(validate: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(validate)
    def check(item: Any, *rest: Any, **options: Any) -> Any:
        good = _GOOD.get()
        if good is None:
            return validate(item, *rest, **options)
        error = None if id(item) in good else validate(item, *rest, **options)
        if not error:
            good[id(item)] = item
        return error

    return check


def _unless_batch(accumulate: Callable[..., None]) -> Callable[..., None]:
    @wraps(accumulate)
    def count(*arguments: Any) -> None:
        if _GOOD.get() is None:
            accumulate(*arguments)

    return count
