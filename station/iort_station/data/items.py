"""Requests for the items of a stream."""

from __future__ import annotations

from typing import Any

from iort_contract.tables import TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud


def of_topic(cloud: Cloud, table: str, robot: str, stream: str, *fields: str) -> dict[str, Any]:
    """A Query's arguments for everything that an output's table has of a stream, or these fields of it."""
    request: dict[str, Any] = {
        "TableName": cloud.output("storage", table),
        "KeyConditionExpression": "#topic = :topic",
        "ExpressionAttributeNames": {"#topic": TOPIC, **{f"#{name}": name for name in fields}},
        "ExpressionAttributeValues": {":topic": {"S": build_topic(RECORD, robot, stream, cloud.namespace)}},
    }
    if fields:
        request["ProjectionExpression"] = ", ".join(f"#{name}" for name in fields)
    return request
