"""DynamoDB: expiry, reserved words in expressions, and the answer of a failed condition."""

from __future__ import annotations

from typing import cast

from botocore.exceptions import ClientError

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
from testkit.target import Target
from testkit.waiting import InstrumentError
from verify.question import Seen, question

_GUIDE = "https://docs.aws.amazon.com/amazondynamodb/latest/developerguide"
_API = "https://docs.aws.amazon.com/amazondynamodb/latest/APIReference"
_TABLES = ("QuarantineTable", "SummaryTable", "TelemetryTable")
_NAMES = sorted({*ENVELOPE, *PRESENCE, *ADMISSION, TOPIC, ROBOT, RECEIVED_MS, EXPIRES_S, STREAMS})


@question(
    "dynamodb.expiry",
    expected=dict.fromkeys(_TABLES, EXPIRES_S),
    source=f"{_GUIDE}/TTL.html",
    relied_on_by=("stacks/storage.py",),
    not_embedded="the emulator's CloudFormation does not give a table its TimeToLiveSpecification",
)
def expiry(target: Target) -> Seen:
    """Telemetry, summaries and quarantine expire by the attribute expires_s."""
    client, found = target.cloud.client("dynamodb"), {}
    for output in _TABLES:
        table = target.cloud.output("storage", output)
        told = client.describe_time_to_live(TableName=table)["TimeToLiveDescription"]
        # Enabling it may take an hour.
        if told["TimeToLiveStatus"] in ("ENABLED", "ENABLING"):
            found[output] = told["AttributeName"]
    return found


@question(
    "dynamodb.reserved_words",
    expected={"refused": [BATCH, "online"]},
    source=f"{_GUIDE}/ReservedWords.html",
    relied_on_by=("functions/presence.py", "functions/admit.py", "station/iort_station/fleet/registry.py"),
)
def reserved_words(target: Target) -> Seen:
    """An expression may name all of the tables' attributes except batch and online."""
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


@question(
    "dynamodb.failed_condition",
    expected={"code": "ConditionalCheckFailedException", "status": 400, "row": True},
    source=f"{_API}/API_UpdateItem.html",
    relied_on_by=("functions/admit.py", "functions/shared/quotas.py", "functions/alert.py"),
)
def failed_condition(target: Target) -> Seen:
    """A failed condition is an error with the current row, if the request asks for it."""
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
        item = cast("dict[str, object]", error.response.get("Item", {}))
        return {
            "code": error.response["Error"]["Code"],
            "status": error.response["ResponseMetadata"]["HTTPStatusCode"],
            "row": item.get(ROBOT) == {"S": name},
        }
    raise InstrumentError("the condition did not fail")
