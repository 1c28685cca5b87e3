"""The hours of streams that are leaving the telemetry table, from the archive."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from iort_contract.archive import (
    ArchivedHour,
    ArchiveTable,
    archived_hour,
    hour_of,
    hours_between,
    parse_hour,
)
from iort_contract.dynamodb import Item
from iort_contract.limits import MAX_BATCH_SPAN_US
from iort_contract.tables import BATCH

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client

# So long before the first item of an hour expires, the table is no longer taken for complete.
_BEFORE_EXPIRY_S = 86_400


class Expired:
    """Reads archived hours as the items that the table had."""

    def __init__(self, table: ArchiveTable, s3: S3Client, bucket: str) -> None:
        self._table, self._s3, self._bucket = table, s3, bucket

    def items(self, topic: str, start_us: int, end_us: int) -> Iterator[Item]:
        """The batches with samples in a range, in order of time, of the hours that the table may lack."""
        first, last = hour_of(start_us - MAX_BATCH_SPAN_US), hour_of(end_us - 1)
        for page in self._table.pages(topic, hours_between(first, last)):
            for item in page.items:
                row = archived_hour(item)
                if row.key and row.first_expires_s < time.time() + _BEFORE_EXPIRY_S:
                    yield from self._of_hour(row, start_us, end_us)

    def _of_hour(self, row: ArchivedHour, start_us: int, end_us: int) -> Iterator[Item]:
        # Its import takes longer than most functions to start.
        from iort_analysis.archive.items import items  # noqa: PLC0415 - see above
        from iort_analysis.archive.reading import ArchiveFile  # noqa: PLC0415 - as above

        content: Any = self._s3.get_object(Bucket=self._bucket, Key=row.key)["Body"].read()
        low, high = f"{max(0, start_us - MAX_BATCH_SPAN_US):016d}", f"{end_us:016d}"
        for item in items(ArchiveFile(content), row.topic, parse_hour(row.hour)):
            if low <= item[BATCH]["S"] < high:
                yield item
