"""The archive and its tables: an hour twice, late and read back; expiry, names and conditions."""

from __future__ import annotations

import io
import time
from typing import Any, NamedTuple

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
from iort_contract.topics import RECORD
from iort_station import data
from iort_station.fleet.robots import Bundle
from iort_station.operations import archive
from testkit.waiting import InstrumentError, until
from verify.lab import Lab, batch, said_by
from verify.question import Seen, question

_BATCHES = 3


class Archived(NamedTuple):
    """A robot whose batches of the hour that began a day ago are archived, and the manifest's row."""

    lab: Lab
    bundle: Bundle
    hour_us: int
    row: ArchivedHour

    @classmethod
    def new(cls, lab: Lab, base: str) -> Archived:
        """Have them archived by the queue. They expire soon, so that queries read the archive."""
        hour_us = (time.time_ns() // 1000 - 24 * HOUR_US) // HOUR_US * HOUR_US
        bundle = lab.driven(base, hour_us, _BATCHES)
        for key in _keys(lab, bundle.robot):
            lab.client("dynamodb").update_item(
                TableName=lab.cloud.output("storage", "TelemetryTable"),
                Key=key,
                UpdateExpression=f"SET {EXPIRES_S} = :soon",
                ExpressionAttributeValues={":soon": {"N": str(int(time.time()) + 3600)}},
            )
        archive.run(lab.cloud, lab.topic(RECORD, bundle.robot))
        (row,) = until(lambda: _rows(lab, bundle.robot), "the hour in the archive", within_s=170)
        return cls(lab, bundle, hour_us, row)

    def archive_again(self) -> ArchivedHour:
        """Give the function the hour's task once more; returns the row after it."""
        task = {TASK: ARCHIVE, TOPIC: self.row.topic, HOUR: self.row.hour}
        self.lab.invoke(self.lab.cloud.output("archive", "ArchiveFunction"), task)
        (row,) = _rows(self.lab, self.bundle.robot)
        return row

    def object(self) -> dict[str, Any]:
        """The archived object as S3 has it."""
        bucket = self.lab.cloud.output("storage", "FilesBucket")
        answer = self.lab.client("s3").get_object(Bucket=bucket, Key=self.row.key)
        return {"content": answer["Body"].read(), "at": str(answer["LastModified"])}


def _rows(lab: Lab, robot: str) -> list[ArchivedHour]:
    """The manifest's rows of the robot."""
    table = ArchiveTable(lab.client("dynamodb"), lab.cloud.output("storage", "ArchiveTable"))
    return [archived_hour(item) for page in table.pages(lab.topic(RECORD, robot)) for item in page.items]


def _keys(lab: Lab, robot: str) -> list[dict[str, Any]]:
    """The keys of the robot's batches in the telemetry table."""
    return [{name: item[name] for name in (TOPIC, BATCH)} for item in lab.items(robot)]


@question(
    "archive.hour_twice",
    aws="sqs:standard-queues-at-least-once-delivery",
    expected={"batches": _BATCHES, "same_row": True, "written_once": True},
)
def hour_twice(lab: Lab) -> Seen:
    """A task that the queue delivers twice changes nothing: the object is not written again, and the
    manifest's row stays."""
    hour = Archived.new(lab, "verify-archived")
    before = hour.object()
    again = hour.archive_again()
    return {
        "batches": hour.row.batches,
        "same_row": again == hour.row,
        "written_once": hour.object() == before,
    }


@question(
    "archive.late_batch",
    aws="s3:conditional-writes",
    expected={
        "batches": _BATCHES + 1,
        "same_object": True,
        "written_again": True,
        "lacking": {},
        "damaged": {},
    },
)
def late_batch(lab: Lab) -> Seen:
    """A batch that comes after its hour was archived is added: S3 replaces the object under the condition
    that it is the one that was read (If-Match), and table, manifest and object agree."""
    hour = Archived.new(lab, "verify-late")
    before = hour.object()
    lab.send(hour.bundle, batch(_BATCHES, first_us=hour.hour_us))
    lab.stored(hour.bundle.robot, _BATCHES + 1)
    later = hour.archive_again()
    verified = archive.verify(lab.cloud, later.topic)
    return {
        "batches": later.batches,
        "same_object": later.key == hour.row.key,
        "written_again": hour.object()["content"] != before["content"],
        "lacking": verified.lacking,
        "damaged": verified.damaged,
    }


@question(
    "archive.read_back",
    aws="s3-api:API_GetObject",
    expected={"in_table": 0, "same_samples": True, "samples": _BATCHES},
)
def read_back(lab: Lab) -> Seen:
    """Once the table has lost the hour, a query (as by `iort query`) reads it from the bucket, with the same
    samples."""
    robot = Archived.new(lab, "verify-read-back").bundle.robot
    before = data.query(lab.cloud, robot, VESC_STREAM)
    for key in _keys(lab, robot):
        lab.client("dynamodb").delete_item(TableName=lab.cloud.output("storage", "TelemetryTable"), Key=key)
    after = data.query(lab.cloud, robot, VESC_STREAM)
    was, now = (
        [rows.times_us.tolist(), {name: column.tolist() for name, column in rows.columns.items()}]
        for rows in (before, after)
    )
    return {"in_table": len(lab.items(robot)), "same_samples": now == was, "samples": len(after)}


@question(
    "archive.pyarrow_arm64",
    aws="lambda:foundation-arch",
    expected={"architectures": ["arm64"], "written_by_pyarrow": True},
    not_embedded="the embedded cloud runs the functions with its host's processor and packages",
)
def pyarrow_arm64(lab: Lab) -> Seen:
    """The layer's pyarrow runs on Lambda's arm64, and this machine's pyarrow reads what it has written."""
    content = Archived.new(lab, "verify-pyarrow").object()["content"]
    written = pyarrow.parquet.read_metadata(io.BytesIO(content)).created_by
    return {
        "architectures": lab.configuration(lab.cloud.output("archive", "ArchiveFunction"))["Architectures"],
        "written_by_pyarrow": written.startswith("parquet-cpp-arrow"),
        "note_written_by": written,
    }


_TABLES = ("QuarantineTable", "SummaryTable", "TelemetryTable")
_NAMES = sorted({*ENVELOPE, *PRESENCE, *ADMISSION, TOPIC, ROBOT, RECEIVED_MS, EXPIRES_S, STREAMS})


@question(
    "dynamodb.expiry",
    aws="dynamodb:TTL",
    expected=dict.fromkeys(_TABLES, EXPIRES_S),
    not_embedded="the emulator's CloudFormation does not give a table its TimeToLiveSpecification",
)
def expiry(lab: Lab) -> Seen:
    """Telemetry, summaries and quarantine expire by the attribute expires_s."""
    expiries = {
        table: lab.client("dynamodb").describe_time_to_live(TableName=lab.cloud.output("storage", table))
        for table in _TABLES
    }
    described = {table: expiry["TimeToLiveDescription"] for table, expiry in expiries.items()}
    # Enabling it may take an hour.
    return {
        table: expiry["AttributeName"]
        for table, expiry in described.items()
        if expiry["TimeToLiveStatus"] in ("ENABLED", "ENABLING")
    }


@question(
    "dynamodb.reserved_words",
    aws="dynamodb:ReservedWords",
    expected={"refused": [BATCH, "online"]},
)
def reserved_words(lab: Lab) -> Seen:
    """An expression may name all of the tables' attributes except batch and online."""

    def refused(name: str) -> bool:
        table, nobody = lab.cloud.output("storage", "RobotsTable"), {ROBOT: {"S": "nobody"}}
        try:
            lab.client("dynamodb").get_item(TableName=table, Key=nobody, ProjectionExpression=name)
        except ClientError as error:
            if said_by(error) != "ValidationException":
                raise
            return True
        return False

    return {"refused": list(filter(refused, _NAMES))}


@question(
    "dynamodb.failed_condition",
    aws="dynamodb-api:API_UpdateItem",
    expected={"code": "ConditionalCheckFailedException", "status": 400, "row": True},
)
def failed_condition(lab: Lab) -> Seen:
    """A failed condition is an error with the current row, if the request asks for it."""
    name = lab.robot("verify-condition").robot
    try:
        lab.client("dynamodb").update_item(
            TableName=lab.cloud.output("storage", "RobotsTable"),
            Key={ROBOT: {"S": name}},
            UpdateExpression="SET verified = :one",
            ConditionExpression=f"attribute_not_exists({ROBOT})",
            ExpressionAttributeValues={":one": {"N": "1"}},
            ReturnValuesOnConditionCheckFailure="ALL_OLD",
        )
    except ClientError as error:
        answer: dict[str, Any] = {**error.response}
        return {
            "code": said_by(error),
            "status": answer["ResponseMetadata"]["HTTPStatusCode"],
            "row": answer.get("Item", {}).get(ROBOT) == {"S": name},
        }
    raise InstrumentError("the condition did not fail")
