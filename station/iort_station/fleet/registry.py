"""The registry: one row per robot in the robots table. A row decides who may claim the robot's name."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from decimal import Decimal
from typing import Any, NamedTuple

from iort_contract import tables
from iort_contract.catalog import derived
from iort_contract.cloud import DRIVER, VIEWER, claim_name, client_prefix
from iort_contract.dynamodb import plain
from iort_contract.limits import ContractError
from iort_contract.messages.page import RobotPresence
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError, unknown

# The vehicle parameters of a row whose owner gives none.
F1TENTH: Mapping[str, float] = asdict(derived.F1TENTH)


def given(vehicle: Mapping[str, float]) -> dict[str, float]:
    """Vehicle parameters as somebody gave them: beside a gain its time is noted, since the analysis trusts no
    default."""
    noted = {tables.GAIN_SET_MS: time.time_ns() // 1_000_000} if "speed_to_erpm_gain" in vehicle else {}
    return {**vehicle, **noted}


def checked(robot: str) -> str:
    """Return a valid robot name; raises `UsageError`."""
    try:
        return check_robot(robot)
    except ContractError as error:
        raise UsageError(str(error)) from error


def listed(cloud: Cloud) -> Iterator[dict[str, Any]]:
    """Every row of the registry, in no order."""
    for page in cloud.client("dynamodb").get_paginator("scan").paginate(TableName=_table(cloud)):
        for item in page["Items"]:
            yield _row(item)


def _row(item: Mapping[str, Any]) -> dict[str, Any]:
    """A row for JSON: a set becomes a sorted list."""
    return {name: sorted(value) if isinstance(value, set) else value for name, value in plain(item).items()}


def vehicles(cloud: Cloud) -> dict[str, dict[str, float]]:
    """What is known of the cars whose speed can be told in m/s, by their names."""
    return {
        str(row[tables.ROBOT]): {
            "speed_to_erpm_gain": float(row["speed_to_erpm_gain"]),
            "speed_to_erpm_offset": float(row.get("speed_to_erpm_offset") or 0),
        }
        for row in listed(cloud)
        if row.get("speed_to_erpm_gain")
    }


def vehicle_of(cloud: Cloud, robot: str) -> derived.Vehicle | None:
    """A robot's vehicle parameters; None without a gain."""
    row = find(cloud, robot) or {}
    gain = float(row.get("speed_to_erpm_gain") or 0)
    return derived.Vehicle(gain, float(row.get("speed_to_erpm_offset") or 0)) if gain else None


def presence(cloud: Cloud) -> dict[str, RobotPresence]:
    """Whether each robot is ``online``, and ``since_ms`` when; None if it has never connected."""
    found: dict[str, RobotPresence] = {}
    for row in listed(cloud):
        online = bool(row.get(tables.ONLINE))
        at_ms = row.get(tables.CONNECTED_MS if online else tables.DISCONNECTED_MS)
        found[str(row[tables.ROBOT])] = {"online": online, "since_ms": None if at_ms is None else int(at_ms)}
    return found


def find(cloud: Cloud, robot: str) -> dict[str, Any] | None:
    """A robot's row; None if it is not registered."""
    answer = cloud.client("dynamodb").get_item(
        TableName=_table(cloud), Key=_key(checked(robot)), ConsistentRead=True
    )
    return _row(answer["Item"]) if "Item" in answer else None


def get(cloud: Cloud, robot: str) -> dict[str, Any]:
    """A robot's row; raises `StationError` if it is not registered."""
    row = find(cloud, robot)
    if row is None:
        raise not_registered(cloud, robot)
    return row


def not_registered(cloud: Cloud, robot: str) -> StationError:
    """The error for a robot that is not registered, with the names nearest to it."""
    known = (str(row[tables.ROBOT]) for row in listed(cloud))
    return unknown(f"robot {robot} is not registered", [robot], known, "iort robots list")


def enter(cloud: Cloud, robot: str, row: Mapping[str, Any]) -> None:
    """Write a new row, which reserves the name; AWS IoT does not refuse a second thing of the same name.

    Raises `StationError` for a registered robot, and for a name that others at the broker may have.
    """
    others = (client_prefix(who, cloud.namespace) for who in (VIEWER, DRIVER))
    kept = (f"{claim_name(cloud.namespace)}-", *others)
    if robot.startswith(kept):
        # A robot's name is its client id. Who connects with the same one takes its connection.
        raise UsageError(f"robot name must not begin with {', '.join(kept)}, got {robot}")
    # TAB needs the names of robots, but not boto3, whose import takes longer than TAB may.
    from boto3.dynamodb.types import TypeSerializer  # noqa: PLC0415 - see above

    serialize = TypeSerializer().serialize
    item = {tables.ROBOT: checked(robot), **row}
    numbers = {name: Decimal(repr(value)) for name, value in item.items() if isinstance(value, int | float)}
    dynamodb = cloud.client("dynamodb")
    try:
        dynamodb.put_item(
            TableName=_table(cloud),
            Item={name: serialize(value) for name, value in {**item, **numbers}.items()},
            ConditionExpression="attribute_not_exists(#robot)",
            ExpressionAttributeNames={"#robot": tables.ROBOT},
        )
    except dynamodb.exceptions.ConditionalCheckFailedException as error:
        raise StationError(f"robot {robot} is already registered; remove it first") from error


def set_vehicle(cloud: Cloud, robot: str, vehicle: Mapping[str, float]) -> dict[str, float]:
    """Change vehicle parameters of a robot; returns the old values of those that it had.

    Raises `StationError` if it is not registered.
    """
    dynamodb = cloud.client("dynamodb")
    try:
        answer = dynamodb.update_item(
            TableName=_table(cloud),
            Key=_key(checked(robot)),
            UpdateExpression="SET " + ", ".join(f"#{name} = :{name}" for name in vehicle),
            ConditionExpression="attribute_exists(#robot)",
            ExpressionAttributeNames={"#robot": tables.ROBOT, **{f"#{name}": name for name in vehicle}},
            ExpressionAttributeValues={f":{name}": {"N": repr(value)} for name, value in vehicle.items()},
            ReturnValues="UPDATED_OLD",
        )
    except dynamodb.exceptions.ConditionalCheckFailedException as error:
        raise not_registered(cloud, robot) from error
    return {name: float(value) for name, value in plain(answer.get("Attributes", {})).items()}


def note_streams(cloud: Cloud, robot: str, names: Sequence[str]) -> None:
    """Note in a registered robot's row that it has these streams, as Lambda 2 does."""
    added = {":streams": {"SS": sorted(set(names))}}
    dynamodb = cloud.client("dynamodb")
    dynamodb.update_item(
        TableName=_table(cloud),
        Key=_key(robot),
        UpdateExpression="ADD #streams :streams",
        ConditionExpression="attribute_exists(#robot)",
        ExpressionAttributeNames={"#streams": tables.STREAMS, "#robot": tables.ROBOT},
        ExpressionAttributeValues=added,
    )


def set_moved(cloud: Cloud, robot: str, origin: str) -> None:
    """Note the deployment that a registered robot has come from."""
    _update(cloud, robot, f"SET {tables.MOVED_FROM} = :origin", {":origin": {"S": origin}})


class ClaimId(NamedTuple):
    """The identity of a claim's certificate: AWS' id, and its SHA-256 in hex."""

    id: str
    fingerprint: str


def open_name(cloud: Cloud, robot: str, *, for_s: float, claim: ClaimId | None) -> None:
    """Allow one certificate for a name within the time, for this claim or for any."""
    values = {":until": {"N": str(int(time.time() + for_s))}}
    update, before = (
        f"SET {tables.ADMIT_UNTIL_S} = :until",
        f"{tables.ADMITTED_CERTIFICATE}, {tables.ADMITTED_MS}",
    )
    if claim is None:
        update += f" REMOVE {before}, {tables.ADMIT_CLAIM}, {tables.ADMIT_FINGERPRINT}"
    else:
        update += (
            f", {tables.ADMIT_CLAIM} = :claim, {tables.ADMIT_FINGERPRINT} = :fingerprint REMOVE {before}"
        )
        values[":claim"] = {"S": claim.id.lower().removeprefix("0x")}
        values[":fingerprint"] = {"S": claim.fingerprint}
    _update(cloud, robot, update, values)


def close_name(cloud: Cloud, robot: str) -> None:
    """Allow no further certificate for a name."""
    _update(cloud, robot, f"REMOVE {tables.ADMIT_UNTIL_S}, {tables.ADMIT_CLAIM}, {tables.ADMIT_FINGERPRINT}")


def forget(cloud: Cloud, robot: str) -> None:
    """Delete a robot's row."""
    cloud.client("dynamodb").delete_item(TableName=_table(cloud), Key=_key(robot))


def _update(cloud: Cloud, robot: str, expression: str, values: Mapping[str, Any] | None = None) -> None:
    valued: Any = {"ExpressionAttributeValues": values} if values else {}
    cloud.client("dynamodb").update_item(
        TableName=_table(cloud),
        Key=_key(robot),
        UpdateExpression=expression,
        ConditionExpression=f"attribute_exists({tables.ROBOT})",
        **valued,
    )


def _table(cloud: Cloud) -> str:
    return cloud.output("storage", "RobotsTable")


def _key(robot: str) -> dict[str, Any]:
    return {tables.ROBOT: {"S": robot}}
