"""The audit of a stream's delivery: batches expected, stored, missing, duplicated and late.

The agent numbers each stream's batches without gaps, also over restarts if its queue has a file. A number
between two stored ones that is not stored is a batch that was lost, or that still waits in the car.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.dynamodb import plain, starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, BatchId, batch_id, decode_batch
from iort_contract.tables import BATCH, RECEIVED_MS, SAMPLES
from iort_station.cloud import Cloud
from iort_station.data.batches import telemetry_table, topic_of

# A batch is late if it took this much longer to arrive than the run's fastest one. It spans a second, and
# arrives within milliseconds if nothing delays it.
LATE_MS = 5_000


class Header(NamedTuple):
    """A stored batch without its samples; ``received_ms`` is the cloud's time."""

    id: BatchId
    samples: int
    received_ms: int


class Missing(NamedTuple):
    """The numbers ``first`` to ``last``, which are not stored; and the start times of their neighbours."""

    first: int
    last: int
    after_us: int | None
    before_us: int | None

    @property
    def batches(self) -> int:
        """The number of batches."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class RunAudit:
    """The stored batches of one run of the agent, from the lowest number to the highest.

    ``first_us`` and ``last_us`` are the start times of its earliest and latest batch. ``samples_of`` has the
    number of samples by batch number.
    """

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
        """The stored and the missing batches."""
        return self.batches + sum(gap.batches for gap in self.missing)


class Shortfall(NamedTuple):
    """Samples that a run took and that are not stored, with the cause; None if their number is unknown."""

    boot: str
    samples: int | None
    cause: str


@dataclass(frozen=True)
class Audit:
    """The audit of one stream; its runs are in the order in which they arrived.

    ``before_first`` counts numbers before the first stored one: expired, outside the range, or lost.
    ``refused`` counts items that are not batches. ``in_car`` and ``dropped`` are the agent's last metrics of
    its queue; None if it sent none. ``taken`` counts the samples that the runs report in their accounts; None
    without an account. ``shortfalls`` are the differences between the accounts and the table.
    """

    stream: str
    runs: list[RunAudit]
    before_first: int = 0
    refused: int = 0
    in_car: int | None = None
    dropped: int | None = None
    taken: int | None = None
    shortfalls: tuple[Shortfall, ...] = ()

    @property
    def missing(self) -> int:
        """The number of missing batches in all runs."""
        return sum(gap.batches for run in self.runs for gap in run.missing)

    @property
    def complete(self) -> bool:
        """Whether everything is stored, or the agent reports that it took nothing."""
        there = bool(self.runs) or self.taken == 0
        return there and not self.missing and not self.refused and not self.shortfalls


def audit(
    stream: str, items: Iterable[Mapping[str, Any]], *, late_ms: int = LATE_MS, from_start: bool = False
) -> Audit:
    """Audit a stream's items, in any order. ``from_start`` counts numbers before the first as missing.

    Lateness is relative to the fastest batch of the same run, so the car's clock may be wrong.
    """
    boots: dict[str, list[Header]] = {}
    refused = 0
    for header in map(_header, items):
        if header is None:
            refused += 1
        else:
            boots.setdefault(header.id.boot, []).append(header)
    # By arrival, since the car's clock may have been set back between two runs.
    in_order = sorted(boots.values(), key=lambda found: min(header.received_ms for header in found))
    runs: list[RunAudit] = []
    before_first = 0
    for found in in_order:
        run = _run(found, late_ms)
        gap = _before(runs[-1] if runs else None, run)
        if not runs and not from_start:
            before_first = run.first_seq
        elif gap is not None:
            run.missing.insert(0, gap)
        runs.append(run)
    return Audit(stream, runs, before_first, refused)


def _header(item: Mapping[str, Any]) -> Header | None:
    """The item's header; None if it is not a batch."""
    try:
        header = Header(batch_id(item[BATCH]), int(item[SAMPLES]), int(item[RECEIVED_MS]))
    except (ContractError, KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return header if header.samples >= 1 else None


def _run(found: list[Header], late_ms: int) -> RunAudit:
    by_seq = {header.id.seq: header for header in found}
    seqs = sorted(by_seq)
    times_us = [header.id.t_us for header in found]
    took_ms = [header.received_ms - header.id.t_us // 1000 for header in found]
    excess_ms = [took - min(took_ms) for took in took_ms]
    return RunAudit(
        boot=found[0].id.boot,
        first_seq=seqs[0],
        last_seq=seqs[-1],
        first_us=min(times_us),
        last_us=max(times_us),
        batches=len(seqs),
        samples=sum(header.samples for header in by_seq.values()),
        duplicated=len(found) - len(seqs),
        late=sum(excess > late_ms for excess in excess_ms),
        latest_ms=max(excess_ms),
        missing=[
            Missing(a + 1, b - 1, by_seq[a].id.t_us, by_seq[b].id.t_us)
            for a, b in pairwise(seqs)
            if b > a + 1
        ],
        samples_of={seq: header.samples for seq, header in by_seq.items()},
    )


def _before(previous: RunAudit | None, run: RunAudit) -> Missing | None:
    """The numbers missing between two runs. A run that starts at a lower number lost its queue; then only its
    own start is known."""
    continued = previous is not None and run.first_seq > previous.last_seq
    first = previous.last_seq + 1 if previous is not None and continued else 0
    if run.first_seq == first:
        return None
    return Missing(first, run.first_seq - 1, previous.last_us if previous else None, run.first_us)


def headers(
    cloud: Cloud, robot: str, stream: str, first_us: int | None = None, last_us: int | None = None
) -> Iterator[dict[str, Any]]:
    """The stored batches that start between two times, both inclusive, without their samples."""
    keys = starting_between(first_us, last_us)
    attributes = (BATCH, SAMPLES, RECEIVED_MS)
    for page in telemetry_table(cloud).pages(topic_of(cloud, robot, stream), keys, attributes=attributes):
        for item in page.items:
            # Strings and numbers only, so no deserializer is needed.
            yield {name: next(iter(value.values())) for name, value in item.items()}


def last_figures(cloud: Cloud, robot: str) -> dict[str, float]:
    """The agent's newest metrics; empty if it has sent none."""
    batch = last_batch(cloud, robot, AGENT_STREAM)
    if batch is None:
        return {}
    newest = {name: column[-1] for name, column in batch.columns.items()}
    return {name: float(value) for name, value in newest.items() if isinstance(value, (int, float))}


def last_batch(cloud: Cloud, robot: str, stream: str) -> Batch | None:
    """The newest stored batch of a stream; None if it has none, or an invalid one."""
    item = telemetry_table(cloud).first(topic_of(cloud, robot, stream), newest=True)
    try:
        return None if item is None else decode_batch(plain(item))
    except ContractError:
        return None
