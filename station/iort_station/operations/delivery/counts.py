"""Samples counted in the tables, stored and summarised."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from iort_contract.dynamodb import plain, starting_between
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.tables import SAMPLES
from iort_station.cloud import Cloud
from iort_station.data.recorded import Recorded, summary_table, topic_of


@dataclass(frozen=True)
class Delivery:
    """The counts of one stream; missing batches are those between the stored ones."""

    samples_stored: int
    batches_stored: int
    batches_missing: int
    samples_summarized: int


def batches(cloud: Cloud, robot: str, stream: str) -> Iterator[Batch]:
    """Every stored batch of a stream, in order of time; raises `iort_contract.ContractError`."""
    yield from map(decode_batch, items(cloud, robot, stream))


def items(cloud: Cloud, robot: str, stream: str) -> Iterator[dict[str, Any]]:
    """Every stored item of a stream, in order of time."""
    for found in Recorded(cloud, robot, stream).items(starting_between(None, None), ()):
        yield from map(plain, found)


def delivery(cloud: Cloud, robot: str, stream: str) -> Delivery:
    """Count what the tables hold of a stream."""
    stored = list(batches(cloud, robot, stream))
    numbers: dict[str, set[int]] = {}
    for batch in stored:
        numbers.setdefault(batch.boot, set()).add(batch.seq)
    return Delivery(
        samples_stored=sum(len(batch.times_us) for batch in stored),
        batches_stored=len(stored),
        batches_missing=sum(max(seqs) - min(seqs) + 1 - len(seqs) for seqs in numbers.values()),
        samples_summarized=samples_summarized(cloud, robot, stream),
    )


def samples_summarized(cloud: Cloud, robot: str, stream: str) -> int:
    """The number of samples in the summary's seconds."""
    pages = summary_table(cloud).pages(topic_of(cloud, robot, stream), attributes=(SAMPLES,))
    return sum(int(item[SAMPLES]["N"]) for page in pages for item in page.items)
