"""Lambda 2: batches off the telemetry table's stream, one item a second into the summary table.

A second is computed from the table, not from the records: whatever order, number or grouping they
arrive in, the last record of a second leaves the same item behind.
"""

from __future__ import annotations

import logging
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import boto3

from contract import (
    EXPIRES_S,
    MAX_BATCH_SPAN_US,
    REPLAY,
    T_US,
    Batch,
    ContractError,
    Value,
    decode_item,
    parse_topic,
)
from functions.health import measure
from functions.metrics import emit
from functions.refusals import Refusals, Refused
from functions.statistics import missing_before, summarize_second
from functions.tables import Tables, plain

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)
_SECOND_US = 1_000_000
# Seconds closer than this are read together: a query costs more than the batches between them.
_READ_TOGETHER_S = 60
# A neighbour that cannot be decoded is passed over for the next; so many of them end the search.
_NEIGHBOURS = 10

BatchKey = tuple[int, str, int]


@dataclass
class Decoded:
    """The good batches of some stream records by topic, and what is wrong with the others."""

    batches: dict[str, list[Batch]] = field(default_factory=lambda: defaultdict(list))
    refused: list[Refused] = field(default_factory=list)


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
    return decoded


class Stored(NamedTuple):
    """A batch as the telemetry table holds it."""

    batch: Batch
    expires_s: int | None


@dataclass
class Summaries:
    """Of one topic: a summary a second, and the batches missing just before those of the event."""

    seconds: dict[int, dict[str, Value]] = field(default_factory=dict)
    missing: int = 0


def summarize_topic(tables: Tables, topic: str, batches: Sequence[Batch]) -> Summaries:
    """The summaries of every second that the batches touch, and of the second of the batch after
    each: a late batch fills the hole that its successor had reported."""
    known = {_key(batch): batch for batch in batches}
    vehicle = tables.vehicle(parse_topic(topic).robot)
    summaries = Summaries()
    for touched in _runs({t_us // _SECOND_US for batch in batches for t_us in batch.times_us}):
        stored = _read(tables, topic, touched[0], touched[-1], known)
        seconds = set(touched)
        previous: Batch | None = None
        for batch, _ in stored:
            if previous is not None and _key(previous) in known:
                seconds.add(batch.t_us // _SECOND_US)
            if _key(batch) in known:
                summaries.missing += missing_before(previous, batch)
            previous = batch
        for second in seconds:
            near = around(stored, second)
            summary = summarize_second(second, [entry.batch for entry in near], vehicle)
            if summary is None:
                continue
            # It is kept as long as what it was made from, which has the time of its receipt: the
            # samples' own may be years off, in a replayed drive or under a car's wrong clock.
            if expires := [entry.expires_s for entry in near if entry.expires_s]:
                summary[EXPIRES_S] = max(expires)
            summaries.seconds[second] = summary
    return summaries


def around(stored: Sequence[Stored], second: int) -> Sequence[Stored]:
    """Of batches in order of time, those with samples in the second and the one before them."""
    start_us, end_us = second * _SECOND_US, (second + 1) * _SECOND_US
    inside = [i for i, (b, _) in enumerate(stored) if b.t_us < end_us and b.times_us[-1] >= start_us]
    return stored[max(0, inside[0] - 1) : inside[-1] + 1] if inside else []


def _runs(seconds: set[int]) -> list[list[int]]:
    """The seconds in order, apart where they are: a car whose clock jumped touches 1970 and today."""
    runs: list[list[int]] = []
    for second in sorted(seconds):
        if not runs or second - runs[-1][-1] > _READ_TOGETHER_S:
            runs.append([])
        runs[-1].append(second)
    return runs


def _read(tables: Tables, topic: str, first: int, last: int, known: Mapping[BatchKey, Batch]) -> list[Stored]:
    """The stored batches with samples from the first second to the last, the one before them, and
    all of the second in which the one after them starts."""
    start_us, end_us = first * _SECOND_US, (last + 1) * _SECOND_US
    stored: list[Stored] = []
    after_s, passed = None, 0
    # One query: nearly always the batches are the newest, and nothing comes after them.
    for item in tables.batches_from(topic, start_us - MAX_BATCH_SPAN_US, at_once=len(known) + _NEIGHBOURS):
        t_us = int(item[T_US])
        if after_s is None and t_us >= end_us:
            passed += 1
        if passed > _NEIGHBOURS or (after_s is not None and t_us // _SECOND_US != after_s):
            break
        for entry in _stored([item], known):
            stored.append(entry)
            if t_us >= end_us:
                after_s = t_us // _SECOND_US
    if stored and stored[0].batch.t_us >= start_us:
        stored = [*_before(tables, topic, stored[0].batch.t_us, known), *stored]
    return stored


def _before(tables: Tables, topic: str, t_us: int, known: Mapping[BatchKey, Batch]) -> list[Stored]:
    found = _stored(islice(tables.before(topic, t_us), _NEIGHBOURS), known)
    return list(islice(found, 1))


def _stored(items: Iterable[Mapping[str, Any]], known: Mapping[BatchKey, Batch]) -> Iterator[Stored]:
    """The items that are batches. Of one that is not, the own record has been or will be refused;
    here it only must not stop its neighbours."""
    for item in items:
        try:
            batch = known.get((int(item[T_US]), item["boot"], int(item["seq"]))) or decode_item(item)[1]
            expires_s = int(item[EXPIRES_S]) if EXPIRES_S in item else None
        except (ContractError, KeyError, TypeError, ValueError, OverflowError):
            continue
        yield Stored(batch, expires_s)


def _key(batch: Batch) -> BatchKey:
    return batch.t_us, batch.boot, batch.seq


Refuse = Callable[[Sequence[Refused]], Sequence[Refused]]


def process(
    event: Mapping[str, Any], tables: Tables, refuse: Refuse, *, robot_metrics: bool = False
) -> dict[str, Any]:
    """Summarise the event's records. Those that cannot be decoded go to ``refuse``, since trying again
    would not change them; the answer names the ones that it could not take.

    The good records behind such a one are kept as well: the service sends them again, which changes
    nothing, and a second need not wait for retries to run out. Of a replay the answer names all that
    cannot be decoded: they are in quarantine already.
    """
    decoded = decode_records(event["Records"])
    topics = {topic: summarize_topic(tables, topic, batches) for topic, batches in decoded.batches.items()}
    tables.put_seconds(
        {
            (topic, second): summary
            for topic, summaries in topics.items()
            for second, summary in summaries.seconds.items()
        }
    )
    left = decoded.refused if event.get(REPLAY) else refuse(decoded.refused)
    good = [batch for batches in decoded.batches.values() for batch in batches]
    emit(
        "summarize",
        BatchesSummarized=len(good),
        SamplesSummarized=sum(len(batch.times_us) for batch in good),
        BatchesRefused=len(decoded.refused),
        BatchesMissing=sum(summaries.missing for summaries in topics.values()),
    )
    for topic, batches in decoded.batches.items():
        _, _, robot, stream = parse_topic(topic)
        emit("health", robot=robot if robot_metrics else None, **measure(stream, batches))
    return {"batchItemFailures": [{"itemIdentifier": refused.number} for refused in left]}


@cache
def _tables() -> Tables:
    return Tables(
        boto3.client("dynamodb"),
        telemetry=os.environ["TELEMETRY_TABLE"],
        summary=os.environ["SUMMARY_TABLE"],
        robots=os.environ["ROBOTS_TABLE"],
    )


@cache
def _refusals() -> Refusals:
    return Refusals(boto3.client("sqs"), queue_url=os.environ["REJECTED_QUEUE"])


def handler(event: dict[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the telemetry table's stream mapping."""
    by_robot = os.environ["ROBOT_METRICS"] == "true"
    return process(event, _tables(), _refusals().refuse, robot_metrics=by_robot)
