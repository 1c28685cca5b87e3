"""A robot's daily upload quota: a count in its row of the robots table."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from iort_contract.tables import FILES_BYTES, FILES_DAY, ROBOT

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient


class UploadQuota:
    """Counts bytes by day (UTC)."""

    def __init__(self, client: DynamoDBClient, *, table: str, bytes_a_day: int) -> None:
        self._client, self._table, self.bytes_a_day = client, table, bytes_a_day

    def take(self, robot: str, size: int, now_s: float) -> bool:
        """Count the size and return True if it fits in today's quota. An unregistered robot has none."""
        if size > self.bytes_a_day:
            return False
        names = {"#day": FILES_DAY, "#bytes": FILES_BYTES}
        values = {
            ":today": {"S": time.strftime("%Y-%m-%d", time.gmtime(now_s))},
            ":size": {"N": str(size)},
        }
        return self._update(
            robot,
            UpdateExpression="ADD #bytes :size",
            ConditionExpression="#day = :today AND #bytes <= :left",
            ExpressionAttributeNames=names,
            ExpressionAttributeValues={**values, ":left": {"N": str(self.bytes_a_day - size)}},
        ) or self._update(
            robot,
            UpdateExpression="SET #day = :today, #bytes = :size",
            ConditionExpression=(
                "attribute_exists(#robot) AND (attribute_not_exists(#day) OR #day <> :today)"
            ),
            ExpressionAttributeNames={**names, "#robot": ROBOT},
            ExpressionAttributeValues=values,
        )

    def _update(self, robot: str, **update: Any) -> bool:
        try:
            self._client.update_item(TableName=self._table, Key={ROBOT: {"S": robot}}, **update)
        except self._client.exceptions.ConditionalCheckFailedException:
            return False
        return True
