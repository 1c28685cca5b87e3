"""DynamoDB: expiry, reserved words in expressions, and the answer of a failed condition."""

from __future__ import annotations

from typing import Any

from botocore.exceptions import ClientError

from bench.target import Target
from iort_contract.tables import (
    ADMISSION,
    BATCH,
    ENVELOPE,
    EXPIRES_S,
    PRESENCE,
    RECEIVED_MS,
    ROBOT,
    STREAMS,
    TOPIC,
)
from verify.assumption import Basis
from verify.check import Check
from verify.errors import VerifyError

_GUIDE = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide"
_API = "https://docs.aws.amazon.com/amazondynamodb/latest/APIReference"
_TABLES = ("QuarantineTable", "SummaryTable", "TelemetryTable")
_NAMES = sorted({*ENVELOPE, *PRESENCE, *ADMISSION, TOPIC, ROBOT, RECEIVED_MS, EXPIRES_S, STREAMS})


def _expiry(target: Target) -> dict[str, Any]:
    client, found = target.cloud.client("dynamodb"), {}
    for output in _TABLES:
        table = target.cloud.output("storage", output)
        told = client.describe_time_to_live(TableName=table)["TimeToLiveDescription"]
        # Enabling it may take an hour.
        if told["TimeToLiveStatus"] in ("ENABLED", "ENABLING"):
            found[output] = told["AttributeName"]
    return found


def _reserved(target: Target) -> dict[str, Any]:
    return {"refused": [name for name in _NAMES if _refused(target, name)]}


def _refused(target: Target, name: str) -> bool:
    table = target.cloud.output("storage", "RobotsTable")
    try:
        target.cloud.client("dynamodb").get_item(
            TableName=table, Key={ROBOT: {"S": "nobody"}}, ProjectionExpression=name
        )
    except ClientError as error:
        if error.response["Error"]["Code"] != "ValidationException":
            raise
        return True
    return False


def _condition(target: Target) -> dict[str, Any]:
    name = target.robot("verify-condition").robot
    try:
        target.cloud.client("dynamodb").update_item(
            TableName=target.cloud.output("storage", "RobotsTable"),
            Key={ROBOT: {"S": name}},
            UpdateExpression="SET verified = :one",
            ConditionExpression=f"attribute_not_exists({ROBOT})",
            ExpressionAttributeValues={":one": {"N": "1"}},
            ReturnValuesOnConditionCheckFailure="ALL_OLD",
        )
    except ClientError as error:
        return {
            "code": error.response["Error"]["Code"],
            "status": error.response["ResponseMetadata"]["HTTPStatusCode"],
            "row": error.response.get("Item", {}).get(ROBOT) == {"S": name},
        }
    raise VerifyError("the condition did not fail")


CHECKS = (
    Check(
        name="dynamodb.expiry",
        assumed="Telemetry, summaries and quarantine expire by the attribute expires_s.",
        expected=dict.fromkeys(_TABLES, EXPIRES_S),
        basis=Basis.DOCUMENTED,
        source=f"{_GUIDE}/TTL.html",
        relied_on_by=("stacks/storage.py",),
        ask=_expiry,
        not_embedded="the emulator's CloudFormation does not give a table its TimeToLiveSpecification",
    ),
    Check(
        name="dynamodb.reserved_words",
        assumed="An expression may name all of the tables' attributes except batch and online.",
        expected={"refused": [BATCH, "online"]},
        basis=Basis.DOCUMENTED,
        source=f"{_GUIDE}/ReservedWords.html",
        relied_on_by=(
            "functions/presence.py",
            "functions/admit.py",
            "station/iort_station/fleet/registry.py",
        ),
        ask=_reserved,
    ),
    Check(
        name="dynamodb.failed_condition",
        assumed="A failed condition is an error with the current row, if the request asks for it.",
        expected={"code": "ConditionalCheckFailedException", "status": 400, "row": True},
        basis=Basis.DOCUMENTED,
        source=f"{_API}/API_UpdateItem.html",
        relied_on_by=("functions/admit.py", "functions/shared/upload_quota.py", "functions/alert.py"),
        ask=_condition,
    ),
)
