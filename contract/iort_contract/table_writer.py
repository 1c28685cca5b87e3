"""Writes to a DynamoDB table, many at a time; the caller hands in the client."""

from __future__ import annotations

import time
from typing import Any, Mapping, Sequence

# BatchWriteItem takes at most this many items a call.
WRITE_SIZE = 25
_WRITE_ATTEMPTS = 8


class TableError(Exception):
    """DynamoDB did not take the items in the time given; the caller may try again."""


def write(client: Any, table: str, requests: Sequence[Mapping[str, Any]]) -> None:
    """Have a table take at most `WRITE_SIZE` writes; raises `TableError` if some stay unwritten."""
    for attempt in range(_WRITE_ATTEMPTS):
        answer = client.batch_write_item(RequestItems={table: requests})
        requests = answer.get("UnprocessedItems", {}).get(table, [])
        if not requests:
            return
        # DynamoDB asks for exponential backoff before unprocessed items are sent again.
        time.sleep(0.02 * 2**attempt)
    raise TableError(f"{len(requests)} items of {table} not written after {_WRITE_ATTEMPTS} attempts")
