"""What arrived: samples counted in the tables, never taken from the sender's word."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from iort_contract.attributes import plain
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.tables import SAMPLES
from iort_station.cloud import Cloud
from iort_station.data.items import of_topic


@dataclass(frozen=True)
class Delivery:
    """Of one stream: samples and batches stored, batches missing between those, samples summarised."""

    samples_stored: int
    batches_stored: int
    batches_missing: int
    samples_summarized: int


def batches(cloud: Cloud, robot: str, stream: str) -> Iterator[Batch]:
    """Every stored batch of a stream, in order of time, page by page.

    Raises `ContractError` for an item that is not a batch.
    """
    yield from map(decode_batch, items(cloud, robot, stream))


def items(cloud: Cloud, robot: str, stream: str) -> Iterator[dict[str, Any]]:
    """Every stored item of a stream as it is, in order of time."""
    return _query(cloud, "TelemetryTable", robot, stream)


def delivery(cloud: Cloud, robot: str, stream: str) -> Delivery:
    """Count what the tables hold of a stream."""
    stored = list(batches(cloud, robot, stream))
    numbers: dict[str, set[int]] = {}
    for batch in stored:
        numbers.setdefault(batch.boot, set()).add(batch.seq)
    missing = sum(max(seqs) - min(seqs) + 1 - len(seqs) for seqs in numbers.values())
    return Delivery(
        samples_stored=sum(len(batch.times_us) for batch in stored),
        batches_stored=len(stored),
        batches_missing=missing,
        samples_summarized=samples_summarized(cloud, robot, stream),
    )


def samples_summarized(cloud: Cloud, robot: str, stream: str) -> int:
    """The samples that the summary's seconds account for."""
    return sum(int(item[SAMPLES]) for item in _query(cloud, "SummaryTable", robot, stream, SAMPLES))


def _query(cloud: Cloud, table: str, robot: str, stream: str, *fields: str) -> Iterator[dict[str, Any]]:
    pages = cloud.client("dynamodb").get_paginator("query")
    for page in pages.paginate(**of_topic(cloud, table, robot, stream, *fields), ConsistentRead=True):
        yield from map(plain, page["Items"])
