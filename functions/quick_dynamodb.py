"""A boto3 DynamoDB client for one that writes much: it does not look at what it is given.

Requests here are this code's own, and items are DynamoDB's JSON before botocore sees them. Its validation
took a third of Lambda 2's processor. Its serializer, which looks up the shape of every value and copies it,
took a fifth, so a BatchWriteItem's parameters become JSON in one pass and botocore is given none of them. Its
events are made for this: boto3, "Extensibility guide".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import boto3
from botocore.config import Config

_OPERATION = "dynamodb.BatchWriteItem"
_BODY = "iort_body"
_write = json.JSONEncoder(separators=(",", ":"), check_circular=False).encode


def client() -> Any:
    """The client, by the usual chain of region and credentials. Its BatchWriteItem takes items that hold no
    bytes."""
    made = boto3.client("dynamodb", config=Config(parameter_validation=False))
    made.meta.events.register_last(f"provide-client-params.{_OPERATION}", _set_aside)
    made.meta.events.register_first(f"before-call.{_OPERATION}", _put_back)
    return made


def _set_aside(params: Mapping[str, Any], context: dict[str, Any], **_: Any) -> dict[str, Any]:
    context[_BODY] = _write(params)
    # Where the request goes may follow from the tables' names.
    return {**params, "RequestItems": {table: [] for table in params["RequestItems"]}}


def _put_back(params: dict[str, Any], context: Mapping[str, Any], **_: Any) -> None:
    params["body"] = context[_BODY].encode()
