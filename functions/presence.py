"""Presence: updates a robot's row of the registry from the broker's lifecycle events.

Lifecycle events may repeat and overtake each other. The broker numbers a client's connections; connect and
disconnect of one connection share a number. The numbers restart at 0 for a client that was away for about an
hour. Source: AWS IoT Core, "Lifecycle events".
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from iort_contract import tables
from iort_contract.catalog.environments import RegistryEnvironment
from iort_contract.limits import ContractError
from iort_contract.tables import AGENT_VERSION, LAST_SEEN_MS, ROBOT, SESSION_VERSION
from iort_contract.topics import check_robot

_log = logging.getLogger(__name__)

# Restarted numbers come an hour later. Events of neighbouring connections are at most two minutes apart
# (clock difference). Half an hour separates the two cases.
_RESTARTED_MS = 30 * 60 * 1000
_MAX_TEXT = 128


def change(event: Mapping[str, Any]) -> dict[str, Any]:
    """The update of the robot's row for an event: UpdateItem's arguments without the table.

    Raises `ContractError` for an event that is not about one of our robots.
    """
    if AGENT_VERSION in event:
        return {
            "Key": {ROBOT: {"S": check_robot(event[ROBOT])}},
            "UpdateExpression": f"SET {AGENT_VERSION} = :version",
            "ConditionExpression": f"attribute_exists({ROBOT})",
            "ExpressionAttributeValues": {":version": _text(event[AGENT_VERSION])},
        }
    kind, at_ms = event.get("eventType"), _number(event, "timestamp")
    values: dict[str, dict[str, Any]] = {
        ":at": {"N": str(at_ms)},
        ":version": {"N": str(_number(event, "versionNumber"))},
        ":long_ago": {"N": str(at_ms - _RESTARTED_MS)},
        ":far_ahead": {"N": str(at_ms + _RESTARTED_MS)},
        ":online": {"BOOL": kind == "connected"},
    }
    # Only a disconnect can follow a connect of the same connection.
    next_ = f"{SESSION_VERSION} < :version"
    if kind == "connected":
        values[":certificate"] = _text(event.get("principalIdentifier"))
        update = f"SET {tables.CONNECTED_MS} = :at, {tables.CERTIFICATE_ID} = :certificate"
        removed = f" REMOVE {tables.DISCONNECT_REASON}"
    elif kind == "disconnected":
        values[":was"] = {"BOOL": True}
        values[":reason"] = _text(event.get("disconnectReason", "UNKNOWN"))
        update = f"SET {tables.DISCONNECTED_MS} = :at, {tables.DISCONNECT_REASON} = :reason"
        removed = ""
        next_ = f"({next_} OR ({SESSION_VERSION} = :version AND #online = :was))"
    else:
        raise ContractError(f"eventType must be connected or disconnected, got {str(kind)[:40]!r}")
    newer = (
        f"attribute_not_exists({SESSION_VERSION}) OR {LAST_SEEN_MS} < :long_ago"
        f" OR ({LAST_SEEN_MS} < :far_ahead AND {next_})"
    )
    return {
        "Key": {ROBOT: {"S": check_robot(event.get("clientId", ""))}},
        "UpdateExpression": (
            f"{update}, #online = :online, {LAST_SEEN_MS} = :at, {SESSION_VERSION} = :version{removed}"
        ),
        # A client without a row is not one of our robots: a claim, or another deployment's.
        "ConditionExpression": f"attribute_exists({ROBOT}) AND ({newer})",
        # "online" is a reserved word.
        "ExpressionAttributeNames": {"#online": tables.ONLINE},
        "ExpressionAttributeValues": values,
    }


def late(event: Mapping[str, Any]) -> dict[str, Any]:
    """The update for a connect event that its own disconnect has overtaken: the robot stays offline."""
    at = {"N": str(_number(event, "timestamp"))}
    return {
        "Key": {ROBOT: {"S": check_robot(event.get("clientId", ""))}},
        "UpdateExpression": f"SET {tables.CONNECTED_MS} = :at, {tables.CERTIFICATE_ID} = :certificate",
        "ConditionExpression": (
            f"{SESSION_VERSION} = :version AND #online = :not"
            f" AND (attribute_not_exists({tables.CONNECTED_MS}) OR {tables.CONNECTED_MS} < :at)"
        ),
        "ExpressionAttributeNames": {"#online": tables.ONLINE},
        "ExpressionAttributeValues": {
            ":at": at,
            ":certificate": _text(event.get("principalIdentifier")),
            ":version": {"N": str(_number(event, "versionNumber"))},
            ":not": {"BOOL": False},
        },
    }


def _number(event: Mapping[str, Any], name: str) -> int:
    value = event.get(name)
    if type(value) is not int or value < 0:
        raise ContractError(f"{name} must be a whole number, got {str(value)[:40]!r}")
    return value


def _text(value: Any) -> dict[str, str]:
    if not isinstance(value, str) or not 1 <= len(value) <= _MAX_TEXT:
        raise ContractError(f"must be a text of up to {_MAX_TEXT} characters, got {str(value)[:40]!r}")
    return {"S": value}


def handler(event: dict[str, Any], _context: object) -> None:
    """Entry point of the rules presence and version. Events without effect are counted."""
    dynamodb, kind = clients.dynamodb(), event.get("eventType")
    table = variables(RegistryEnvironment).robots_table
    missed = dynamodb.exceptions.ConditionalCheckFailedException
    try:
        try:
            dynamodb.update_item(TableName=table, **change(event))
        except missed:
            if kind != "connected":
                raise
            dynamodb.update_item(TableName=table, **late(event))
    except (ContractError, missed) as error:
        _log.info("ignored: %s", error)
        emit("presence", PresenceIgnored=1)
        return
    emit("presence", RobotsConnected=kind == "connected", RobotsDisconnected=kind == "disconnected")
