"""The adapters of the archive's writer, from its environment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from functions.shared import clients
from functions.shared.archive.marks import Marks
from functions.shared.archive.objects import Objects
from functions.shared.environment import variables
from iort_contract.archive import HOUR, ArchivedHour, ArchiveTable, Hour, archived_hour
from iort_contract.catalog.environments import ArchiveEnvironment
from iort_contract.dynamodb import TelemetryTable, quick
from iort_contract.tables import TOPIC

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient
    from types_boto3_sqs import SQSClient


@dataclass(frozen=True)
class Archive:
    """The tables, the bucket and the queue."""

    client: DynamoDBClient
    telemetry: TelemetryTable
    manifest: ArchiveTable
    marks: Marks
    objects: Objects
    queue: SQSClient
    given: ArchiveEnvironment

    def row(self, topic: str, hour: Hour) -> ArchivedHour | None:
        """An hour's row of the manifest."""
        key = {TOPIC: {"S": topic}, HOUR: {"S": str(hour)}}
        answer = self.client.get_item(TableName=self.manifest.name, Key=key, ConsistentRead=True)
        return archived_hour(answer["Item"]) if "Item" in answer else None


@cache
def archive() -> Archive:
    """The archive of this environment's deployment."""
    given = variables(ArchiveEnvironment)
    client = quick(clients.dynamodb())
    return Archive(
        client,
        TelemetryTable(client, given.telemetry_table),
        ArchiveTable(client, given.archive_table),
        Marks(client, given.archive_table),
        Objects(clients.s3(), given.files_bucket),
        clients.sqs(),
        given,
    )
