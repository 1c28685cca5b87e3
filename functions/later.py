"""Later: summarises batches that `summarize` put off because their robot was over its share.

A message names the batches; the telemetry table holds them. They get the same treatment as there. A
failed message comes again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from functions.shared.share import waiting
from functions.shared.summary import processed, stored_tables
from functions.shared.tables import Tables
from iort_contract.tables import BATCH, TOPIC


class LaterError(Exception):
    """Batches that can be neither summarised nor put into quarantine now."""


def records(tables: Tables, body: str) -> list[dict[str, Any]]:
    """The stream records of the batches that a message names, without those that have expired."""
    found: list[dict[str, Any]] = []
    for number, (topic, batch) in enumerate(waiting(body)):
        item = tables.telemetry.get(topic, batch)
        if item is not None:
            change: dict[str, Mapping[str, Any] | str] = {
                "Keys": {name: item[name] for name in (TOPIC, BATCH)},
                "NewImage": item,
                "SequenceNumber": str(number),
            }
            found.append({"eventID": "later", "eventName": "INSERT", "dynamodb": change})
    return found


def handler(event: dict[str, Any], _context: object) -> None:
    """Entry point of the queue's mapping, which delivers one message at a time."""
    for message in event["Records"]:
        again = {"Records": records(stored_tables(), message["body"])}
        if failed := processed(again, beside_others=True)["batchItemFailures"]:
            raise LaterError(f"the quarantine's queue did not take {len(failed)} batches")
