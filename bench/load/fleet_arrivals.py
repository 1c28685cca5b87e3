"""Counts the arrived batches and samples of a fleet in the tables, robot by robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from bench.load.fleet_load import SAMPLES as BATCH_SAMPLES
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH, RECEIVED_MS, SECOND
from iort_station.cloud import Cloud
from iort_station.data.batches import summary_table, topic_of
from iort_station.operations import delivery
from iort_station.operations.audit import headers

# Takes the share done and the name of the step.
Tell = Callable[[float, str], None]
# After so long without a change no more comes.
_CATCH_UP_S = 120.0


@dataclass(frozen=True)
class Stored:
    """One robot's batches in the table; ``missing`` counts the batches that were sent and are not there.

    ``ordered`` is True if they arrived and are stored in the order of their numbers. ``delays_ms`` has the
    time that each took to the rule.
    """

    batches: int
    missing: int
    ordered: bool
    delays_ms: list[float]


def stored(cloud: Cloud, robot: str, sent_ms: list[int]) -> Stored:
    """Compare a robot's items with the batches that it sent."""
    items = list(headers(cloud, robot, VESC_STREAM))
    seqs = [batch_id(item[BATCH]).seq for item in items]
    received = [int(item[RECEIVED_MS]) for item in items]
    return Stored(
        batches=len(items),
        missing=len(set(range(len(sent_ms))) - set(seqs)),
        ordered=seqs == sorted(seqs) and received == sorted(received),
        delays_ms=[float(ms - sent_ms[seq]) for seq, ms in zip(seqs, received, strict=True)],
    )


def summarized(cloud: Cloud, expected: dict[str, int], tell: Tell) -> int:
    """Count the samples in the summaries of all robots, after all have arrived or no more come.

    It waits for one robot after the other, since all lag equally.
    """
    total, since = 0, time.monotonic()
    for name, samples in expected.items():
        counted, looked_at = 0, None
        while True:
            # Counting is expensive: count only when the summaries reach the last second that was sent.
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
    return delivery.samples_summarized(cloud, robot, VESC_STREAM)


def _spanned(cloud: Cloud, robot: str) -> int:
    """Return the seconds from a robot's first to its last summary."""
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)
    ends = [table.first(topic, newest=newest, attributes=(SECOND,)) for newest in (False, True)]
    first, last = (0 if item is None else int(item[SECOND]["N"]) for item in ends)
    return last - first + 1 if last else 0
