"""What arrived of a fleet's drive, counted in the tables, robot by robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from bench.fleet_load import SAMPLES as BATCH_SAMPLES
from iort_contract import BATCH, RECEIVED_MS, SAMPLES, SECOND, VESC_STREAM, batch_id
from iort_contract.attributes import plain
from iort_station.cloud import Cloud
from iort_station.data.items import of_topic

# Hears the share done, and of what.
Tell = Callable[[float, str], None]
# So long without any news, and no more comes.
_CATCH_UP_S = 120.0


@dataclass(frozen=True)
class Stored:
    """Of one robot: its batches in the table, how many of those it sent are ``missing``, whether they lie
    there and came in the order of their numbers, and what each took to the rule."""

    batches: int
    missing: int
    ordered: bool
    delays_ms: list[float]


def stored(cloud: Cloud, robot: str, sent_ms: list[int]) -> Stored:
    """A robot's items against what it sent: which are there, and in the order of their numbers."""
    items = list(_items(cloud, "TelemetryTable", robot, BATCH, RECEIVED_MS))
    seqs = [batch_id(item[BATCH]).seq for item in items]
    received = [int(item[RECEIVED_MS]) for item in items]
    return Stored(
        batches=len(items),
        missing=len(set(range(len(sent_ms))) - set(seqs)),
        ordered=seqs == sorted(seqs) and received == sorted(received),
        delays_ms=[float(ms - sent_ms[seq]) for seq, ms in zip(seqs, received, strict=True)],
    )


def summarized(cloud: Cloud, expected: dict[str, int], tell: Tell) -> int:
    """The samples in the summary of all robots, once they are all there or no more come.

    One robot is asked for after the other: all are equally far behind, so the one that is waited for tells.
    """
    total, since = 0, time.monotonic()
    for name, samples in expected.items():
        counted, looked_at = 0, None
        while True:
            # To count is dear: not before its seconds go as far as what was sent.
            spanned = _spanned(cloud, name)
            if spanned * BATCH_SAMPLES >= samples:
                counted = _samples(cloud, name)
            if looked_at not in {None, (counted, spanned)}:
                since = time.monotonic()
            looked_at = counted, spanned
            tell(spanned * BATCH_SAMPLES / samples, "waiting for the summaries")
            if counted >= samples:
                break
            if time.monotonic() - since > _CATCH_UP_S:
                counted = _samples(cloud, name)
                break
            threading.Event().wait(0.5)
        total += counted
    return total


def _samples(cloud: Cloud, robot: str) -> int:
    return sum(int(item[SAMPLES]) for item in _items(cloud, "SummaryTable", robot, SAMPLES))


def _spanned(cloud: Cloud, robot: str) -> int:
    """The seconds from a robot's first to its last summary."""
    query = cloud.client("dynamodb").query
    seconds = of_topic(cloud, "SummaryTable", robot, VESC_STREAM, SECOND)
    ends = [
        int(item[SECOND]["N"])
        for forward in (True, False)
        for item in query(**seconds, ScanIndexForward=forward, Limit=1)["Items"]
    ]
    return ends[1] - ends[0] + 1 if ends else 0


def _items(cloud: Cloud, table: str, robot: str, *fields: str) -> Iterator[dict[str, Any]]:
    pages = cloud.client("dynamodb").get_paginator("query")
    for page in pages.paginate(**of_topic(cloud, table, robot, VESC_STREAM, *fields)):
        yield from map(plain, page["Items"])
