"""The resource of a request to DynamoDB Streams.

AWS: is the stream's ARN, so that a role may be granted one stream
  (https://docs.aws.amazon.com/service-authorization/latest/reference/list_amazondynamodb.html).
ministack: takes the request for one about every resource, which such a grant does not allow.
Test: tests/local/test_gaps.py::test_a_request_about_a_stream_names_it
Patch: local/patches/stream_arn.patch
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.core import iam_actions
from ministack.services import dynamodb_streams

_REQUEST: tuple[Any, ...] = (
    "dynamodbstreams",
    "POST",
    "/",
    {},
    b'{"StreamArn": "arn:stream"}',
    {},
    "eu-west-1",
    "000000000000",
)


def install() -> None:
    """Close the gap in this process."""
    iam_actions.extract_resource_arn = knowing_streams(iam_actions.extract_resource_arn)


def is_open() -> bool:
    """Ask for the resource of a request."""
    return bool(iam_actions.extract_resource_arn(*_REQUEST) != "arn:stream")


def knowing_streams(resource_arn: Callable[..., str]) -> Callable[..., str]:
    """The resource of a request, for a stream its ARN."""

    @wraps(resource_arn)
    def extract(service: str, *request: Any) -> str:
        if service != "dynamodbstreams":
            return resource_arn(service, *request)
        try:
            asked = json.loads(request[3] or b"{}")
        except ValueError:
            asked = {}
        iterator = dynamodb_streams._decode_iterator(asked.get("ShardIterator") or "") or {}
        return str(asked.get("StreamArn") or iterator.get("arn") or "*")

    return extract
