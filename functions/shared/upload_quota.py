"""A robot's daily upload quota: a count in its row of the robots table."""

from __future__ import annotations

import time
from typing import Any

from botocore.exceptions import ClientError

from iort_contract.tables import FILES_BYTES, FILES_DAY, ROBOT


class Allotment:
    """Counts by day (UTC); ``client`` is a boto3 DynamoDB client."""

    def __init__(self, client: Any, *, table: str, bytes_a_day: int) -> None:
        self._client, self._table, self.bytes_a_day = client, table, bytes_a_day

    def take(self, robot: str, size: int, now_s: float) -> bool:
        """Count the size and return True if it fits in today's quota. An unregistered robot has none."""
        if size > self.bytes_a_day:
            return False
        values = {
            ":today": {"S": time.strftime("%Y-%m-%d", time.gmtime(now_s))},
            ":size": {"N": str(size)},
        }
        counted = self._update(
            robot,
            "ADD #bytes :size",
            "#day = :today AND #bytes <= :left",
            {**values, ":left": {"N": str(self.bytes_a_day - size)}},
        )
        return counted or self._update(
            robot,
            "SET #day = :today, #bytes = :size",
            "attribute_exists(#robot) AND (attribute_not_exists(#day) OR #day <> :today)",
            values,
        )

    def _update(self, robot: str, update: str, condition: str, values: dict[str, Any]) -> bool:
        names = {"#day": FILES_DAY, "#bytes": FILES_BYTES, "#robot": ROBOT}
        try:
            self._client.update_item(
                TableName=self._table,
                Key={ROBOT: {"S": robot}},
                UpdateExpression=update,
                ConditionExpression=condition,
                ExpressionAttributeNames={k: name for k, name in names.items() if k in update + condition},
                ExpressionAttributeValues=values,
            )
        except ClientError as error:
            if error.response["Error"]["Code"] != "ConditionalCheckFailedException":
                raise
            return False
        return True
