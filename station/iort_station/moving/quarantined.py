"""Moves a robot's quarantined messages, byte for byte."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from iort_contract.dynamodb import Item
from iort_contract.tables import ENTRY, EXPIRES_S, LAST_MS, ROBOT
from iort_station.cloud import Cloud


def copy(source: Cloud, target: Cloud, robot: str) -> int:
    """Copy the messages that the target lacks; returns how many."""
    wanted = lacking(source, target, robot)
    client, table = target.client("dynamodb"), target.output("storage", "QuarantineTable")
    for item in _items(source, robot) if wanted else ():
        if item[ENTRY]["S"] in wanted:
            client.put_item(TableName=table, Item=item)
    return len(wanted)


def lacking(source: Cloud, target: Cloud, robot: str) -> set[str]:
    """The ids of the source's messages that the target does not have."""
    names = {"#robot": ROBOT, "#id": ENTRY, "#expires": EXPIRES_S, "#last": LAST_MS}
    keys = {"ProjectionExpression": "#id, #expires, #last", "ExpressionAttributeNames": names}
    # Of a message that was replayed the id is left.
    there = {item[ENTRY]["S"] for item in _items(target, robot, **keys)}
    now_s = time.time()
    return {
        str(item[ENTRY]["S"])
        for item in _items(source, robot, **keys)
        if LAST_MS in item
        and item[ENTRY]["S"] not in there
        # DynamoDB is about to delete those that have expired.
        and (EXPIRES_S not in item or int(item[EXPIRES_S]["N"]) > now_s)
    }


def _items(cloud: Cloud, robot: str, **request: Any) -> Iterator[Item]:
    asked = {
        "TableName": cloud.output("storage", "QuarantineTable"),
        "ConsistentRead": True,
        "KeyConditionExpression": "#robot = :robot",
        "ExpressionAttributeNames": {"#robot": ROBOT},
        "ExpressionAttributeValues": {":robot": {"S": robot}},
        **request,
    }
    for page in cloud.client("dynamodb").get_paginator("query").paginate(**asked):
        yield from page["Items"]
