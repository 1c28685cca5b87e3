"""The audit of a stream's delivery: batches expected, stored, missing, duplicated and late.

Each run of the agent numbers its batches of a stream from 0 without gaps, and its first batches name the runs
before it with their last numbers, as far as its queue knows. A number that is not stored is a batch that was
lost, or that still waits in the car."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import Any, NamedTuple

from iort_analysis.archive.stored import HEADER, Origin, only
from iort_analysis.samples.batches import ATTRIBUTES, RefusedItems, part
from iort_contract.archive import HASH
from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.checks import shown
from iort_contract.dynamodb import Keys, plain, seconds_between, starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.account import StreamAccount
from iort_contract.messages.batch import Batch, BatchId, RunEnd, batch_id, decode_batch, run_ends
from iort_contract.tables import BATCH, PREVIOUS, RECEIVED_MS, SAMPLES
from iort_station.cloud import Cloud
from iort_station.data.accounts import SILENT_US, Account
from iort_station.data.recorded import Recorded, summary_table, topic_of

# So many batches are decoded together.
_TOGETHER = 200
# A batch is late if it took this much longer to arrive than the run's fastest one. It spans a second, and
# arrives within milliseconds if nothing delays it.
LATE_MS = 5_000


class Header(NamedTuple):
    """A stored batch without its samples; ``received_ms`` is the cloud's time."""

    id: BatchId
    samples: int
    received_ms: int
    previous: tuple[RunEnd, ...] | None


class Missing(NamedTuple):
    """The numbers ``first`` to ``last``, which are not stored; and the start times of their neighbours."""

    first: int
    last: int
    after_us: int | None
    before_us: int | None

    @property
    def batches(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True)
class RunAudit:
    """The stored batches of one run of the agent, from the lowest number to the highest.

    ``first_us`` and ``last_us`` are the start times of its earliest and latest batch. ``samples_of`` has the
    number of samples by batch number. ``late`` and ``latest_ms`` are None if the samples' times do not tell:
    those of a recording that was played at another speed.
    """

    boot: str
    first_seq: int
    last_seq: int
    first_us: int
    last_us: int
    batches: int
    samples: int
    duplicated: int
    late: int | None
    latest_ms: int | None
    missing: list[Missing]
    samples_of: Mapping[int, int]

    @property
    def expected(self) -> int:
        """The stored and the missing batches."""
        return self.batches + sum(gap.batches for gap in self.missing)


class LostRun(NamedTuple):
    """A run that a later one names, and of whose batches none is stored."""

    boot: str
    batches: int


class Shortfall(NamedTuple):
    """Samples that a run took and that are not stored, with the cause; None if their number is unknown."""

    boot: str
    samples: int | None
    cause: str


@dataclass(frozen=True)
class Audit:
    """The audit of one stream; its runs are in the order in which they arrived.

    ``before_first`` counts numbers before the first stored one: expired, outside the range, or lost.
    ``refused`` counts what is stored and cannot be read, and ``named`` has the first of these. ``in_car``
    and ``dropped`` are the agent's last metrics of its queue; None if it sent none. After a run that ended
    in good order, nothing is in the car. ``taken`` counts the samples that the runs report in their accounts,
    None without one; ``shortfalls`` are the differences between accounts and table.
    """

    stream: str
    runs: list[RunAudit]
    before_first: int = 0
    refused: int = 0
    named: tuple[str, ...] = ()
    in_car: int | None = None
    dropped: int | None = None
    taken: int | None = None
    shortfalls: tuple[Shortfall, ...] = ()
    lost_runs: tuple[LostRun, ...] = ()

    @property
    def missing(self) -> int:
        """The number of missing batches in all runs."""
        stored_runs = sum(gap.batches for run in self.runs for gap in run.missing)
        return stored_runs + sum(run.batches for run in self.lost_runs)

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
    ends = _ends(in_order)
    runs: list[RunAudit] = []
    before_first = 0
    for found in in_order:
        run = _run(found, ends.get(found[0].id.boot, -1), late_ms)
        if not runs and not from_start:
            before_first = run.first_seq
        elif run.first_seq > 0:
            after_us = runs[-1].last_us if runs else None
            run.missing.insert(0, Missing(0, run.first_seq - 1, after_us, run.first_us))
        runs.append(run)
    lost_runs = tuple(_lost_runs(in_order, ends, from_start=from_start))
    return Audit(stream, runs, before_first, refused, lost_runs=lost_runs)


def _ends(runs: Iterable[Sequence[Header]]) -> dict[str, int]:
    """The last number of each run that a batch names."""
    ends: dict[str, int] = {}
    for found in runs:
        for boot, seq in (end for stored in found for end in stored.previous or ()):
            ends[boot] = max(seq, ends.get(boot, -1))
    return ends


def _lost_runs(
    in_order: Sequence[Sequence[Header]], ends: Mapping[str, int], *, from_start: bool
) -> Iterator[LostRun]:
    """The named runs of which nothing is stored. Those before the first stored one have expired, or are out
    of the range, or were lost."""
    names = [found[0].id.boot for found in in_order]
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


def _header(item: Mapping[str, Any]) -> Header | None:
    """The item's header; None if it is not a batch."""
    try:
        previous = run_ends(item[PREVIOUS]) if PREVIOUS in item else None
        header = Header(batch_id(item[BATCH]), int(item[SAMPLES]), int(item[RECEIVED_MS]), previous)
    except (ContractError, KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return header if header.samples >= 1 else None


def _check_header(item: Mapping[str, Any]) -> None:
    """Raise `ContractError` for what the audit does not take for a batch."""
    if _header(item) is None:
        raise ContractError(f"{RECEIVED_MS} must be a time, got {shown(item.get(RECEIVED_MS))}")


def _run(found: Sequence[Header], last: int, late_ms: int) -> RunAudit:
    by_seq = {header.id.seq: header for header in found}
    seqs = sorted(by_seq)
    times_us = [header.id.t_us for header in found]
    took_ms = [header.received_ms - header.id.t_us // 1000 for header in found]
    fastest_ms = min(took_ms)
    excess_ms = [took - fastest_ms for took in took_ms]
    missing = [
        Missing(a + 1, b - 1, by_seq[a].id.t_us, by_seq[b].id.t_us) for a, b in pairwise(seqs) if b > a + 1
    ]
    if last > seqs[-1]:
        missing.append(Missing(seqs[-1] + 1, last, by_seq[seqs[-1]].id.t_us, None))
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
        missing=missing,
        samples_of={seq: header.samples for seq, header in by_seq.items()},
    )


def headers(
    cloud: Cloud,
    robot: str,
    stream: str,
    first_us: int | None = None,
    last_us: int | None = None,
    *,
    origin: Origin | None = None,
    refused: RefusedItems | None = None,
) -> Iterator[dict[str, Any]]:
    """The stored batches that start between two times, both inclusive, without their samples.

    Each batch of the table is decoded. Of one that cannot be read the header is empty, and ``refused`` names
    it. The archive's writer has decoded what is there, and `iort archive verify` checks it by digests.
    ``origin`` grows by what comes from the archive.
    """
    recorded = Recorded(cloud, robot, stream, origin=origin, refused=refused)
    items = recorded.headers(starting_between(first_us, last_us), (*HEADER, *ATTRIBUTES))
    while page := list(islice(items, _TOGETHER)):
        written = [item for item in page if HASH not in item]
        damaged = RefusedItems()
        part(written, damaged)
        for item in page:
            # Strings and numbers only, so no deserializer is needed.
            header = {
                name: next(iter(item[name].values()), None)
                for name in HEADER
                if isinstance(item.get(name), dict)
            }
            try:
                if damaged.count and HASH not in item:
                    decode_batch(plain(item))
                _check_header(header)
            except ContractError as error:
                recorded.refused.add(error, header.get(BATCH, ""))
                header = {}
            yield header


def last_figures(cloud: Cloud, robot: str) -> dict[str, float]:
    """The agent's newest metrics; empty if it has sent none."""
    batch = last_batch(cloud, robot, AGENT_STREAM)
    if batch is None:
        return {}
    newest = {name: column[-1] for name, column in batch.columns.items()}
    return {name: float(value) for name, value in newest.items() if isinstance(value, (int, float))}


def last_batch(cloud: Cloud, robot: str, stream: str) -> Batch | None:
    """The newest stored batch of a stream; None if it has none, or an invalid one."""
    recorded = Recorded(cloud, robot, stream)
    last = recorded.before(None)
    try:
        found = None if last is None else next(recorded.items(only(last)), None)
        return decode_batch(plain(found[0])) if found else None
    except ContractError:
        return None


# The accounts that an agent's runs publish, compared with the stored batches.

# What is lost with a run that did not end properly, by whether its queue was durable; None is not known.
_OPEN = "were in open batches, at most one second"
NOT_ENDED = {
    True: f"{_OPEN}: the run did not end properly",
    False: f"{_OPEN}, or waited in the queue, which was in memory: the run did not end properly",
    None: f"{_OPEN}, or in the queue if it was in memory: the run did not end properly",
}


def held_against(one: Audit, found: Mapping[str, Account], now_us: int) -> Audit:
    """The audit of a stream with its shortfalls against the runs' accounts."""
    stored = {run.boot: run for run in one.runs}
    accounted = {boot: run for boot, run in found.items() if one.stream in run.streams}
    newest_us = max((run.received_us for run in found.values()), default=0)
    lacking: list[Shortfall] = []
    for boot, run in accounted.items():
        stream = run.streams[one.stream]
        is_last = run.received_us == newest_us and now_us - run.received_us < SILENT_US
        running = is_last and not stream.ended
        lacking += shortfalls(boot, stream, stored.get(boot), running=running)
    taken = sum(run.streams[one.stream].taken for run in accounted.values()) if accounted else None
    return replace(one, taken=taken, shortfalls=tuple(lacking))


def without_lateness(one: Audit, found: Mapping[str, Account]) -> Audit:
    """The audit without the lateness of recordings that were played at another speed than their own."""

    def told(run: RunAudit) -> RunAudit:
        account = found[run.boot].streams.get(one.stream) if run.boot in found else None
        return replace(run, late=None, latest_ms=None) if account is not None and account.replayed else run

    return replace(one, runs=[told(run) for run in one.runs])


def in_car(last: int | None, audits: Iterable[Audit], found: Mapping[str, Account]) -> int | None:
    """How many batches are in the car: the figure that it sent last, which is of a minute before its end. A
    run that ended in good order says so in its last batch, behind all others: it has left nothing."""
    newest = max(found.values(), key=lambda run: run.received_us, default=None)
    ended = newest is not None and all(stream.ended for stream in newest.streams.values())
    return 0 if last and ended and not any(one.missing or one.shortfalls for one in audits) else last


def shortfalls(
    boot: str, stream: StreamAccount, stored: RunAudit | None, *, running: bool
) -> Iterator[Shortfall]:
    """What a run's account of a stream says that is not stored."""
    if stream.refused:
        yield Shortfall(boot, stream.refused, "refused by the agent: no message can hold them")
    if not stream.ended and not running:
        yield Shortfall(boot, None, NOT_ENDED[stream.durable])
    if stored is None:
        if stream.stored:
            yield Shortfall(boot, stream.stored, "in batches that are not stored")
        return
    # `Audit.before_first` reports numbers before the first stored one, which may have expired. The last
    # batches of a running agent may be on their way.
    if stored.first_seq > stream.first_seq or (running and stored.last_seq < stream.next_seq - 1):
        return
    there = sum(samples for seq, samples in stored.samples_of.items() if seq < stream.next_seq)
    if there != stream.stored:
        yield Shortfall(boot, stream.stored - there, "put into the queue, but not in the table")


# Samples counted in the tables, stored and summarised.


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


def delivery(cloud: Cloud, robot: str, stream: str, run: str | None = None) -> Delivery:
    """Count what the tables hold of a stream, of one ``run`` of the agent or of all."""
    stored = [batch for batch in batches(cloud, robot, stream) if run in {None, batch.boot}]
    seconds = None
    if run is not None:
        # Two runs of a robot are not in the same second.
        first_us = min((batch.times_us[0] for batch in stored), default=0)
        last_us = max((batch.times_us[-1] for batch in stored), default=0)
        seconds = seconds_between(first_us // 1_000_000, last_us // 1_000_000)
    numbers: dict[str, set[int]] = {}
    for batch in stored:
        numbers.setdefault(batch.boot, set()).add(batch.seq)
    return Delivery(
        samples_stored=sum(len(batch.times_us) for batch in stored),
        batches_stored=len(stored),
        batches_missing=sum(max(seqs) - min(seqs) + 1 - len(seqs) for seqs in numbers.values()),
        samples_summarized=samples_summarized(cloud, robot, stream, seconds),
    )


def samples_summarized(cloud: Cloud, robot: str, stream: str, seconds: Keys | None = None) -> int:
    """The number of samples in the summary's seconds."""
    pages = summary_table(cloud).pages(topic_of(cloud, robot, stream), seconds, attributes=(SAMPLES,))
    return sum(int(item[SAMPLES]["N"]) for page in pages for item in page.items)
