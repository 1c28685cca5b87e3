"""The archive and its tables: an hour twice, late and read back; expiry, names and conditions."""

from __future__ import annotations

import io
import json
import time
from typing import Any, cast

import pyarrow.parquet
from botocore.exceptions import ClientError

from iort_contract.archive import ARCHIVE, HOUR, HOUR_US, TASK, ArchivedHour, ArchiveTable, archived_hour
from iort_contract.catalog.vesc import VESC_STREAM
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
from iort_station import data
from iort_station.fleet.robots import Bundle
from iort_station.operations import archive
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import Seen, question
from verify.tools import batch, items, send, stored, topic

_SQS = "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide"
_S3 = "https://docs.aws.amazon.com/AmazonS3/latest/userguide"
_LAMBDA = "https://docs.aws.amazon.com/lambda/latest/dg"
_BATCHES, _WITHIN_S = 3, 170.0


def _sent(target: Target, bundle: Bundle, first: int, count: int) -> None:
    """Send batches of one sample each, of the hour that began a day ago, and wait for them in the table."""
    hour_us = (time.time_ns() // 1000 - 24 * HOUR_US) // HOUR_US * HOUR_US
    send(target, bundle, *(batch(first + number, first_us=hour_us) for number in range(count)))
    stored(target, bundle.robot, first + count)


def _rows(target: Target, robot: str) -> list[ArchivedHour]:
    """The manifest's rows of the robot."""
    table = ArchiveTable(target.cloud.client("dynamodb"), target.cloud.output("storage", "ArchiveTable"))
    return [archived_hour(item) for page in table.pages(topic(target, robot)) for item in page.items]


def _again(target: Target, row: ArchivedHour) -> None:
    """Give the function the task of an archived hour once more, and wait for its end."""
    answer = target.cloud.client("lambda").invoke(
        FunctionName=target.cloud.output("archive", "ArchiveFunction"),
        Payload=json.dumps({TASK: ARCHIVE, TOPIC: row.topic, HOUR: row.hour}),
    )
    if "FunctionError" in answer:
        raise InstrumentError(f"the archive's function failed: {answer['Payload'].read()!r}")


def _object(target: Target, row: ArchivedHour) -> dict[str, Any]:
    """An archived object as S3 has it."""
    bucket = target.cloud.output("storage", "FilesBucket")
    answer = target.cloud.client("s3").get_object(Bucket=bucket, Key=row.key)
    return {"content": answer["Body"].read(), "at": str(answer["LastModified"])}


def _hour(target: Target, base: str) -> tuple[Bundle, ArchivedHour]:
    """A new robot whose batches of an hour are archived, by the queue. They expire soon, so that queries read
    the archive."""
    bundle = target.robot(base)
    _sent(target, bundle, 0, _BATCHES)
    for key in _keys(target, bundle.robot):
        target.cloud.client("dynamodb").update_item(
            TableName=target.cloud.output("storage", "TelemetryTable"),
            Key=key,
            UpdateExpression=f"SET {EXPIRES_S} = :soon",
            ExpressionAttributeValues={":soon": {"N": str(int(time.time()) + 3600)}},
        )
    archive.run(target.cloud, topic(target, bundle.robot))
    (row,) = until(lambda: _rows(target, bundle.robot), "the hour in the archive", within_s=_WITHIN_S)
    return bundle, row


def _keys(target: Target, robot: str) -> list[dict[str, Any]]:
    """The keys of the robot's batches in the telemetry table."""
    return [{name: item[name] for name in (TOPIC, BATCH)} for item in items(target, robot)]


@question(
    "archive.hour_twice",
    expected={"batches": _BATCHES, "same_row": True, "written_once": True},
    source=f"{_SQS}/standard-queues-at-least-once-delivery.html",
    relied_on_by=("functions/shared/archive_writer.py", "stacks/archive.py"),
)
def hour_twice(target: Target) -> Seen:
    """A task that the queue delivers twice changes nothing: the object is not written again, and the
    manifest's row stays."""
    bundle, row = _hour(target, "verify-archived")
    before = _object(target, row)
    _again(target, row)
    return {
        "batches": row.batches,
        "same_row": _rows(target, bundle.robot) == [row],
        "written_once": _object(target, row) == before,
    }


@question(
    "archive.late_batch",
    expected={
        "batches": _BATCHES + 1,
        "same_object": True,
        "written_again": True,
        "lacking": {},
        "damaged": {},
    },
    source=f"{_S3}/conditional-writes.html",
    relied_on_by=("functions/shared/archive_writer.py", "functions/shared/archive.py"),
)
def late_batch(target: Target) -> Seen:
    """A batch that comes after its hour was archived is added: S3 replaces the object under the condition
    that it is the one that was read (If-Match), and table, manifest and object agree."""
    bundle, row = _hour(target, "verify-late")
    before = _object(target, row)
    _sent(target, bundle, _BATCHES, 1)
    _again(target, row)
    (later,) = _rows(target, bundle.robot)
    verified = archive.verify(target.cloud, later.topic)
    return {
        "batches": later.batches,
        "same_object": later.key == row.key,
        "written_again": _object(target, later)["content"] != before["content"],
        "lacking": verified.lacking,
        "damaged": verified.damaged,
    }


@question(
    "archive.read_back",
    expected={"in_table": 0, "same_samples": True, "samples": _BATCHES},
    source=f"{_S3}/range-get-olap.html",
    relied_on_by=(
        "analysis/iort_analysis/archive/hours.py",
        "station/iort_station/data/recorded.py",
    ),
)
def read_back(target: Target) -> Seen:
    """Once the table has lost the hour, a query (as by `iort query`) reads it from the bucket, with the same
    samples."""
    bundle, _row = _hour(target, "verify-read-back")
    cloud, robot = target.cloud, bundle.robot
    before = data.query(cloud, robot, VESC_STREAM)
    for key in _keys(target, robot):
        cloud.client("dynamodb").delete_item(TableName=cloud.output("storage", "TelemetryTable"), Key=key)
    after = data.query(cloud, robot, VESC_STREAM)
    same = {name: column.tolist() for name, column in after.columns.items()}
    return {
        "in_table": len(items(target, robot)),
        "same_samples": after.times_us.tolist() == before.times_us.tolist()
        and same == {name: column.tolist() for name, column in before.columns.items()},
        "samples": len(after),
    }


@question(
    "archive.pyarrow_arm64",
    expected={"architectures": ["arm64"], "written_by_pyarrow": True},
    source=f"{_LAMBDA}/foundation-arch.html",
    relied_on_by=("stacks/parts.py", "scripts/setup.py", "analysis/iort_analysis/archive/writing.py"),
    not_embedded="the embedded cloud runs the functions with its host's processor and packages",
)
def pyarrow_arm64(target: Target) -> Seen:
    """The layer's pyarrow runs on Lambda's arm64, and this machine's pyarrow reads what it has written."""
    _bundle, row = _hour(target, "verify-pyarrow")
    written = pyarrow.parquet.read_metadata(io.BytesIO(_object(target, row)["content"])).created_by
    configuration = target.cloud.client("lambda").get_function_configuration(
        FunctionName=target.cloud.output("archive", "ArchiveFunction")
    )
    return {
        "architectures": configuration["Architectures"],
        "written_by_pyarrow": written.startswith("parquet-cpp-arrow"),
        "note_written_by": written,
    }


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
