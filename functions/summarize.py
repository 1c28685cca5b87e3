"""Lambda 2: batches off the telemetry table's stream, one item a second into the summary table.

A second is computed from the table, not from the records: whatever order, number or grouping they
arrive in, the last record of a second leaves the same item behind.
"""

from __future__ import annotations

import gc
import logging
import os
import time
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache, partial
from typing import Any

import boto3

from contract import (
    EXPIRES_S,
    MAX_BATCH_SPAN_US,
    RECEIVED_MS,
    RECOMPUTE_FROM_S,
    RECOMPUTED,
    REPLAY,
    Batch,
    BatchId,
    ContractError,
    Statistics,
    decode_item,
    parse_topic,
)
from functions import quick_dynamodb
from functions.health import measure, together
from functions.metrics import emit
from functions.refusals import Refusals, Refused
from functions.statistics import summarize_second
from functions.stored import SECOND_BATCHES, Reader, Stored
from functions.tables import Tables, plain

# Topics that are read side by side; a client keeps ten connections.
_AT_ONCE = 4
_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)
_SECOND_US = 1_000_000
# Seconds closer than this are read together, since a query costs as much as the batches between them; and
# only so many of them, since they are held in memory.
_NEAR_S, _READ_TOGETHER_S = 10, 60
# A stream keeps its records for 24 hours. What was received before was put into the table by hand (`iort
# adopt`, a replay), and is no news of its car.
_NEWS_MS = 24 * 3_600_000
_BEYOND = f"its second has {SECOND_BATCHES} batches of the stream before it, or too large ones"


@dataclass
class Decoded:
    """The good batches of some stream records by topic, and what is wrong with the others."""

    batches: dict[str, list[Batch]] = field(default_factory=lambda: defaultdict(list))
    records: dict[tuple[str, BatchId], Mapping[str, Any]] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)

    def refuse(self, topic: str, keys: AbstractSet[BatchId], reason: str) -> None:
        """Count batches of a topic among what is refused."""
        self.batches[topic] = [batch for batch in self.batches[topic] if batch.id not in keys]
        for change in (self.records[topic, key] for key in sorted(keys)):
            self.refused.append(Refused(change["SequenceNumber"], reason, change["NewImage"]))

    def news(self, since_ms: int) -> dict[str, list[Batch]]:
        """The batches that the cloud received at that time or later, of topics that have some."""
        found: dict[str, list[Batch]] = {}
        for topic, batches in self.batches.items():
            for batch in batches:
                received = self.records[topic, batch.id]["NewImage"].get(RECEIVED_MS)
                if received is None or Decimal(received["N"]) >= since_ms:
                    found.setdefault(topic, []).append(batch)
        return found


def decode_records(records: Iterable[Mapping[str, Any]]) -> Decoded:
    """Read stream records. Removals (expiry) carry no image and are passed over."""
    decoded = Decoded()
    for record in records:
        image = record["dynamodb"].get("NewImage")
        if image is None:
            continue
        try:
            topic, batch = decode_item(plain(image))
        except ContractError as error:
            _log.warning("refused %s of %s: %s", record["dynamodb"]["Keys"], record["eventID"], error)
            decoded.refused.append(Refused(record["dynamodb"]["SequenceNumber"], str(error), image))
        else:
            decoded.batches[str(topic)].append(batch)
            decoded.records[str(topic), batch.id] = record["dynamodb"]
    return decoded


@dataclass
class Summaries:
    """Of one topic: a summary a second, the batches missing just before those of the event, and those of
    the event that are beyond what their second may hold."""

    seconds: dict[int, dict[str, Statistics]] = field(default_factory=dict)
    missing: int = 0
    beyond: set[BatchId] = field(default_factory=set)


def summarize_topic(tables: Tables, topic: str, batches: Sequence[Batch]) -> Summaries:
    """The summaries of every second that the batches touch, and of the second of the batch after
    each: a late batch fills the hole that its successor had reported."""
    known = {batch.id: batch for batch in batches}
    reader = Reader(tables, topic, known)
    vehicle = tables.vehicle(parse_topic(topic).robot)
    summaries = Summaries()
    within: set[BatchId] = set()
    for touched in _runs({second for batch in batches for second in _seconds(batch)}):
        stored = reader.read(touched[0], touched[-1])
        seconds = set(touched)
        previous: Batch | None = None
        missing: dict[int, int] = defaultdict(int)
        for batch, _, beyond in stored:
            second = batch.t_us // _SECOND_US
            # What is read in front of a run is there in part, and belongs to another, as does what follows.
            if previous is not None and previous.id in known and second >= touched[0]:
                seconds.add(second)
            if second in seconds:
                lacking = reader.missing_before(batch, previous, stored)
                missing[second] += lacking
                if batch.id in known and not beyond and second <= touched[-1]:
                    within.add(batch.id)
                    summaries.missing += lacking
            previous = batch
        for second in seconds:
            near = around(stored, second)
            batches_near = [entry.batch for entry in near]
            summary = summarize_second(second, batches_near, vehicle, missing[second])
            if summary is None:
                continue
            # It is kept as long as what it was made from, which has the time of its receipt: the
            # samples' own may be years off, in a replayed drive or under a car's wrong clock.
            if expires := [entry.expires_s for entry in near if entry.expires_s]:
                summary[EXPIRES_S] = max(expires)
            summaries.seconds[second] = summary
    summaries.beyond = {key for key in known if key.t_us // _SECOND_US in reader.full} - within
    return summaries


def around(stored: Sequence[Stored], second: int) -> Sequence[Stored]:
    """Of batches in order of time, those with samples in the second and the one before them, without what
    is beyond the second itself."""
    start_us, end_us = second * _SECOND_US, (second + 1) * _SECOND_US
    first = bisect_left(stored, start_us - MAX_BATCH_SPAN_US, key=_start)
    end = bisect_left(stored, end_us, lo=first, key=_start)
    inside = [i for i in range(first, end) if stored[i].batch.times_us[-1] >= start_us]
    near = stored[max(0, inside[0] - 1) : inside[-1] + 1] if inside else []
    return [entry for entry in near if not (entry.beyond and entry.batch.t_us >= start_us)]


def _seconds(batch: Batch) -> range:
    return range(batch.times_us[0] // _SECOND_US, batch.times_us[-1] // _SECOND_US + 1)


def _start(entry: Stored) -> int:
    return entry.batch.t_us


def _runs(seconds: set[int]) -> list[list[int]]:
    """The seconds in order, apart where they are: a car whose clock jumped touches 1970 and today."""
    runs: list[list[int]] = []
    for second in sorted(seconds):
        if not runs or second - runs[-1][-1] > _NEAR_S or second - runs[-1][0] >= _READ_TOGETHER_S:
            runs.append([])
        runs[-1].append(second)
    return runs


Refuse = Callable[[Sequence[Refused]], Sequence[Refused]]


def process(
    event: Mapping[str, Any],
    tables: Tables,
    refuse: Refuse,
    *,
    robot_metrics: bool = False,
    at_once: int = 1,
    news_since_ms: int = 0,
) -> dict[str, Any]:
    """Summarise the event's records. Those that cannot be decoded go to ``refuse``, since trying again
    would not change them; the answer names the ones that it could not take.

    The good records behind such a one are kept as well: the service sends them again, which changes
    nothing, and a second need not wait for retries to run out. Of a replay the answer names all that
    cannot be decoded: they are in quarantine already. ``at_once`` topics are read side by side, which have
    nothing to do with each other and mostly wait for the table. What was received before ``news_since_ms``
    is summarised, and in no metric that an alarm is set on.
    """
    decoded = decode_records(event["Records"])
    topics = _summarized(tables, decoded.batches, at_once)
    tables.put_seconds(
        {
            (topic, second): summary
            for topic, summaries in topics.items()
            for second, summary in summaries.seconds.items()
        }
    )
    for name in map(parse_topic, topics):
        tables.note_stream(name.robot, name.name)
    for topic, summaries in topics.items():
        decoded.refuse(topic, summaries.beyond, _BEYOND)
    left = decoded.refused if event.get(REPLAY) else refuse(decoded.refused)
    good = [batch for batches in decoded.batches.values() for batch in batches]
    news = decoded.news(news_since_ms)
    emit(
        "summarize",
        BatchesSummarized=len(good),
        SamplesSummarized=sum(len(batch.times_us) for batch in good),
        BatchesRefused=len(decoded.refused),
        BatchesMissing=sum(summaries.missing for topic, summaries in topics.items() if topic in news),
    )
    measured = [
        (parse_topic(topic).robot, measure(parse_topic(topic).name, batches))
        for topic, batches in news.items()
    ]
    if robot_metrics:
        for robot, values in measured:
            emit("health", robot=robot, **values)
    else:
        for values in together(values for _, values in measured):
            emit("health", robot=None, **values)
    return {"batchItemFailures": [{"itemIdentifier": refused.number} for refused in left]}


def recompute(event: Mapping[str, Any], tables: Tables) -> dict[str, Any]:
    """Summarise stored batches once more, with the vehicle's parameters as they are now: the operator has
    corrected them. Seconds before ``event[RECOMPUTE_FROM_S]`` stay as they are.

    Nothing is counted or put into quarantine a second time. The answer has the seconds that were written, and
    the records of which nothing can be made.
    """
    tables.forget_vehicles()
    decoded = decode_records(event["Records"])
    written: dict[tuple[str, int], Mapping[str, Statistics]] = {}
    for topic, summaries in _summarized(tables, decoded.batches, 1).items():
        for second, summary in summaries.seconds.items():
            if second >= event[RECOMPUTE_FROM_S]:
                written[topic, second] = summary
        decoded.refuse(topic, summaries.beyond, _BEYOND)
    tables.put_seconds(written)
    return {
        RECOMPUTED: sorted(second for _, second in written),
        "batchItemFailures": [{"itemIdentifier": refused.number} for refused in decoded.refused],
    }


def _summarized(tables: Tables, batches: Mapping[str, Sequence[Batch]], at_once: int) -> dict[str, Summaries]:
    if at_once == 1 or len(batches) == 1:
        return {topic: summarize_topic(tables, topic, several) for topic, several in batches.items()}
    with ThreadPoolExecutor(min(at_once, max(1, len(batches)))) as pool:
        found = pool.map(partial(summarize_topic, tables), batches, batches.values())
        return dict(zip(batches, found, strict=True))


@cache
def _tables() -> Tables:
    tables = Tables(
        quick_dynamodb.client(),
        telemetry=os.environ["TELEMETRY_TABLE"],
        summary=os.environ["SUMMARY_TABLE"],
        robots=os.environ["ROBOTS_TABLE"],
    )
    # botocore's models are a hundred thousand objects that stay: no event's collection need pass them again.
    gc.collect()
    gc.freeze()
    return tables


@cache
def _refusals() -> Refusals:
    return Refusals(boto3.client("sqs"), queue_url=os.environ["REJECTED_QUEUE"])


def handler(event: dict[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the telemetry table's stream mapping, and of the operator's replays."""
    if RECOMPUTE_FROM_S in event:
        return recompute(event, _tables())
    by_robot = os.environ["ROBOT_METRICS"] == "true"
    since_ms = int(time.time() * 1000) - _NEWS_MS
    return process(
        event,
        _tables(),
        _refusals().refuse,
        robot_metrics=by_robot,
        at_once=_AT_ONCE,
        news_since_ms=since_ms,
    )
