"""Presence: keeps the registry's row of a robot by what the broker says of its connections.

Lifecycle events may come twice and overtake each other. The broker numbers a client's connections;
connect and disconnect of one connection have the same number, and it starts again at 0 for a client
that was away for about an hour. Source: AWS IoT Core, "Lifecycle events".
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from functools import cache
from typing import Any

import boto3

from functions.shared.metrics import emit
from iort_contract import (
    AGENT_VERSION,
    CERTIFICATE_ID,
    CONNECTED_MS,
    DISCONNECT_REASON,
    DISCONNECTED_MS,
    LAST_SEEN_MS,
    ONLINE,
    ROBOT,
    SESSION_VERSION,
    ContractError,
    check_robot,
)

_log = logging.getLogger(__name__)

# Numbers that start again come an hour later, two events of neighbouring connections with clocks up to
# two minutes apart; half an hour tells them from each other.
_RESTARTED_MS = 30 * 60 * 1000
_MAX_TEXT = 128


def change(event: Mapping[str, Any]) -> dict[str, Any]:
    """What an event does to its robot's row: UpdateItem's arguments but for the table.

    Raises `ContractError` for an event that is not about a robot of ours.
    """
    if AGENT_VERSION in event:
        return {
            "Key": {ROBOT: {"S": check_robot(event[ROBOT])}},
            "UpdateExpression": f"SET {AGENT_VERSION} = :version",
            "ConditionExpression": f"attribute_exists({ROBOT})",
            "ExpressionAttributeValues": {":version": {"S": _text(event[AGENT_VERSION])}},
        }
    kind, at_ms = event.get("eventType"), _number(event, "timestamp")
    values: dict[str, dict[str, Any]] = {
        ":at": {"N": str(at_ms)},
        ":version": {"N": str(_number(event, "versionNumber"))},
        ":long_ago": {"N": str(at_ms - _RESTARTED_MS)},
        ":far_ahead": {"N": str(at_ms + _RESTARTED_MS)},
    }
    # What comes after within a connection is its end alone.
    next_ = f"{SESSION_VERSION} < :version"
    if kind == "connected":
        values[":online"] = {"BOOL": True}
        values[":certificate"] = {"S": _text(event.get("principalIdentifier"))}
        update = f"SET {CONNECTED_MS} = :at, {CERTIFICATE_ID} = :certificate"
        removed = f" REMOVE {DISCONNECT_REASON}"
    elif kind == "disconnected":
        values[":online"] = {"BOOL": False}
        values[":was"] = {"BOOL": True}
        values[":reason"] = {"S": _text(event.get("disconnectReason", "UNKNOWN"))}
        update = f"SET {DISCONNECTED_MS} = :at, {DISCONNECT_REASON} = :reason"
        removed = ""
        next_ = f"({next_} OR ({SESSION_VERSION} = :version AND #online = :was))"
    else:
        raise ContractError(f"eventType {str(kind)[:40]!r}: allowed is connected or disconnected")
    newer = (
        f"attribute_not_exists({SESSION_VERSION}) OR {LAST_SEEN_MS} < :long_ago"
        f" OR ({LAST_SEEN_MS} < :far_ahead AND {next_})"
    )
    return {
        "Key": {ROBOT: {"S": check_robot(event.get("clientId", ""))}},
        "UpdateExpression": (
            f"{update}, #online = :online, {LAST_SEEN_MS} = :at, {SESSION_VERSION} = :version{removed}"
        ),
        # A client that has no row is no robot of ours: a claim, or another deployment's.
        "ConditionExpression": f"attribute_exists({ROBOT}) AND ({newer})",
        # A reserved word.
        "ExpressionAttributeNames": {"#online": ONLINE},
        "ExpressionAttributeValues": values,
    }


def _number(event: Mapping[str, Any], name: str) -> int:
    value = event.get(name)
    if type(value) is not int or value < 0:
        raise ContractError(f"{name} {str(value)[:40]!r}: expected a whole number")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str) or not 1 <= len(value) <= _MAX_TEXT:
        raise ContractError(f"{str(value)[:40]!r}: expected a text of up to {_MAX_TEXT} characters")
    return value


@cache
def _dynamodb() -> Any:
    return boto3.client("dynamodb")


def handler(event: dict[str, Any], _context: object) -> None:
    """Entry point of the rules presence and version. An event that changes nothing is counted."""
    dynamodb = _dynamodb()
    try:
        dynamodb.update_item(TableName=os.environ["ROBOTS_TABLE"], **change(event))
    except (ContractError, dynamodb.exceptions.ConditionalCheckFailedException) as error:
        _log.info("ignored: %s", error)
        emit("presence", PresenceIgnored=1)
        return
    kind = event.get("eventType")
    emit("presence", RobotsConnected=kind == "connected", RobotsDisconnected=kind == "disconnected")
