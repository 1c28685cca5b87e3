"""Proof of delivery: the numbers of a stream's batches, expected, stored, missing, twice and late.

Each run of the agent numbers its batches of a stream from 0 without gaps, and its first batches name the runs
before it with their last numbers, as far as its queue knows. A number that is not stored is a batch that was
lost, or is still in the car. Agents before that numbered on over restarts where the queue had a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from iort_contract.attributes import plain
from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, RunEnd, batch_id, batches_between, decode_batch, run_ends
from iort_contract.tables import BATCH, PREVIOUS, RECEIVED_MS, SAMPLES, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data.items import of_topic

# Later than the run's fastest batch by more than this. A batch is a second long, and the next one
# that is sent at once arrives within milliseconds.
LATE_MS = 5_000


class Stored(NamedTuple):
    """What the telemetry table says of one batch, without its samples. ``received_ms`` is the cloud's."""

    boot: str
    seq: int
    t_us: int
    samples: int
    received_ms: int
    previous: tuple[RunEnd, ...] | None


class Missing(NamedTuple):
    """Numbers ``first`` to ``last`` that are not stored, between the samples' times of their neighbours."""

    first: int
    last: int
    after_us: int | None
    before_us: int | None

    @property
    def batches(self) -> int:
        """How many."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class Run:
    """One run of the agent: its batches from the lowest number to the highest, when its samples are, and
    how many each batch has, by its number."""

    boot: str
    first_seq: int
    last_seq: int
    first_us: int
    last_us: int
    batches: int
    samples: int
    duplicated: int
    late: int
    latest_ms: int
    missing: list[Missing]
    samples_of: Mapping[int, int]

    @property
    def expected(self) -> int:
        """Batches from the first number to the last, and those missing before the first."""
        return self.batches + sum(gap.batches for gap in self.missing)


class LostRun(NamedTuple):
    """A run that a later one names, and of whose batches none is stored."""

    boot: str
    batches: int


class Shortfall(NamedTuple):
    """A difference between what a run says it took and what is stored: how many samples, None where nobody
    can know, and why."""

    boot: str
    samples: int | None
    cause: str


@dataclass(frozen=True)
class Audit:
    """Of one stream: its runs in the order of their receipt, and the runs of which nothing is stored.

    ``before_first`` numbers lie before the first stored one: expired, outside of the range asked for, or
    lost. ``refused`` items are not batches. ``in_car`` and ``dropped`` are what the agent last said of
    its queue, None where it said nothing. ``taken`` are the samples that the runs say they took, None where
    none said so, and ``shortfalls`` in what the table differs from that.
    """

    stream: str
    runs: list[Run]
    before_first: int = 0
    refused: int = 0
    in_car: int | None = None
    dropped: int | None = None
    taken: int | None = None
    shortfalls: tuple[Shortfall, ...] = ()
    lost_runs: tuple[LostRun, ...] = ()

    @property
    def missing(self) -> int:
        """Batches missing in all runs."""
        stored_runs = sum(gap.batches for run in self.runs for gap in run.missing)
        return stored_runs + sum(run.batches for run in self.lost_runs)

    @property
    def complete(self) -> bool:
        """Nothing is missing or unreadable, and there is something, or the agent says that there was not."""
        there = bool(self.runs) or self.taken == 0
        return there and not self.missing and not self.refused and not self.shortfalls


def audit(
    stream: str, items: Iterable[Mapping[str, Any]], *, late_ms: int = LATE_MS, from_start: bool = False
) -> Audit:
    """Look at a stream's items, in any order. ``from_start`` counts numbers before the first as missing.

    A batch is late by how much longer it took to arrive than the fastest of its run, so that the car's
    clock may be off.
    """
    boots: dict[str, list[Stored]] = {}
    refused = 0
    for stored in map(_stored, items):
        if stored is None:
            refused += 1
        else:
            boots.setdefault(stored.boot, []).append(stored)
    # In the order in which the cloud got them: a car's clock may have been set back between two runs.
    in_order = sorted(boots.values(), key=lambda found: min(s.received_ms for s in found))
    ends = _ends(in_order)
    runs: list[Run] = []
    before_first = 0
    numbered_on: Run | None = None
    for found in in_order:
        run = _run(found, ends.get(found[0].boot, -1), late_ms)
        from_0 = any(stored.previous is not None for stored in found)
        first = _first(None if from_0 else numbered_on, run)
        if not runs and not from_start:
            before_first = run.first_seq
        elif run.first_seq > first:
            after_us = runs[-1].last_us if runs else None
            run.missing.insert(0, Missing(first, run.first_seq - 1, after_us, run.first_us))
        runs.append(run)
        numbered_on = numbered_on if from_0 else run
    lost_runs = tuple(_lost_runs(in_order, ends, from_start=from_start))
    return Audit(stream, runs, before_first, refused, lost_runs=lost_runs)


def _ends(runs: Iterable[Sequence[Stored]]) -> dict[str, int]:
    """The last number of each run that a batch names."""
    ends: dict[str, int] = {}
    for found in runs:
        for boot, seq in (end for stored in found for end in stored.previous or ()):
            ends[boot] = max(seq, ends.get(boot, -1))
    return ends


def _lost_runs(
    in_order: Sequence[Sequence[Stored]], ends: Mapping[str, int], *, from_start: bool
) -> Iterator[LostRun]:
    """The named runs of which nothing is stored. Those before the first stored one have expired, or are out
    of the range, or were lost."""
    names = [found[0].boot for found in in_order]
    seen = set(names)
    for i, found in enumerate(in_order):
        for previous in (stored.previous for stored in found if stored.previous):
            named = [end.boot for end in previous]
            # A run that was stored earlier and is not named is older than those that are.
            within = from_start or not set(names[:i]) <= set(named)
            for boot in named:
                within |= boot in names
                if within and boot not in seen:
                    seen.add(boot)
                    yield LostRun(boot, ends[boot] + 1)


def _run(found: Sequence[Stored], last: int, late_ms: int) -> Run:
    by_seq: dict[int, Stored] = {}
    duplicated = 0
    for stored in found:
        duplicated += stored.seq in by_seq
        by_seq[stored.seq] = stored
    seqs = sorted(by_seq)
    missing = [Missing(a + 1, b - 1, by_seq[a].t_us, by_seq[b].t_us) for a, b in pairwise(seqs) if b > a + 1]
    if last > seqs[-1]:
        missing.append(Missing(seqs[-1] + 1, last, by_seq[seqs[-1]].t_us, None))
    took_ms = [stored.received_ms - stored.t_us // 1000 for stored in found]
    excess_ms = [took - min(took_ms) for took in took_ms]
    return Run(
        boot=found[0].boot,
        first_seq=seqs[0],
        last_seq=seqs[-1],
        first_us=min(stored.t_us for stored in found),
        last_us=max(stored.t_us for stored in found),
        batches=len(seqs),
        samples=sum(stored.samples for stored in by_seq.values()),
        duplicated=duplicated,
        late=sum(excess > late_ms for excess in excess_ms),
        latest_ms=max(excess_ms),
        missing=missing,
        samples_of={seq: stored.samples for seq, stored in by_seq.items()},
    )


def _first(previous: Run | None, run: Run) -> int:
    """The number that a run began with: 0, or the one after those of the run before, where runs numbered on.
    A number that starts again lower is a queue that was lost."""
    return previous.last_seq + 1 if previous is not None and run.first_seq > previous.last_seq else 0


def _stored(item: Mapping[str, Any]) -> Stored | None:
    """The item as a batch; None if it is not one."""
    try:
        t_us, boot, seq = batch_id(item[BATCH])
        previous = run_ends(item[PREVIOUS]) if PREVIOUS in item else None
        stored = Stored(boot, seq, t_us, int(item[SAMPLES]), int(item[RECEIVED_MS]), previous)
    except (ContractError, KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return stored if stored.samples >= 1 else None


@dataclass(frozen=True)
class Range:
    """Of the batches' first samples, both ends included; None is open."""

    first_us: int | None = None
    last_us: int | None = None

    def values(self) -> dict[str, dict[str, str]]:
        """As DynamoDB's expression values."""
        first, last = batches_between(self.first_us, self.last_us)
        return {":first": {"S": first}, ":last": {"S": last}}


def headers(cloud: Cloud, robot: str, stream: str, within: Range) -> Iterator[dict[str, Any]]:
    """The stored batches without their samples, page by page: what an audit needs and no more."""
    names = {"#topic": TOPIC, "#batch": BATCH, "#n": SAMPLES, "#at": RECEIVED_MS, "#previous": PREVIOUS}
    pages = cloud.client("dynamodb").get_paginator("query")
    for page in pages.paginate(
        TableName=cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression="#topic = :topic AND #batch BETWEEN :first AND :last",
        ProjectionExpression="#batch, #n, #at, #previous",
        ExpressionAttributeNames=names,
        ExpressionAttributeValues={
            ":topic": {"S": build_topic(RECORD, robot, stream, cloud.namespace)},
            **within.values(),
        },
        ConsistentRead=True,
    ):
        for item in page["Items"]:
            # One attribute each, a string or a number, without the cost of a deserializer.
            yield {name: next(iter(value.values())) for name, value in item.items()}


def last_figures(cloud: Cloud, robot: str) -> dict[str, float]:
    """The newest sample of the agent's own figures; empty where it has sent none."""
    batch = last_batch(cloud, robot, AGENT_STREAM)
    if batch is None:
        return {}
    newest = {name: column[-1] for name, column in batch.columns.items()}
    return {name: float(value) for name, value in newest.items() if isinstance(value, (int, float))}


def last_batch(cloud: Cloud, robot: str, stream: str) -> Batch | None:
    """The newest stored batch of a stream; None where there is none that can be read."""
    answer = cloud.client("dynamodb").query(
        **of_topic(cloud, "TelemetryTable", robot, stream),
        ScanIndexForward=False,
        ConsistentRead=True,
        Limit=1,
    )
    try:
        return next((decode_batch(plain(item)) for item in answer["Items"]), None)
    except ContractError:
        return None
