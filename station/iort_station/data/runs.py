"""The runs of a robot's agent, what each recorded, and the laps in it; the runs are found without reading it.

The key of a batch has its time, its run and its number within the run. A batch spans at most a second, so the
number tells how far back the run may have begun; the batch before its first one is the last of another run.
A run of a stream thus costs some four reads of one batch, however long it is. Runs that recorded the same
stream at the same time may look shorter than they are.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import NamedTuple

from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.drives.building import build
from iort_analysis.drives.drive import motion_of
from iort_analysis.mining import laps
from iort_analysis.mining.gain import with_gain
from iort_analysis.results import Mined
from iort_analysis.samples.batches import ATTRIBUTES
from iort_analysis.samples.blocks import Block
from iort_analysis.samples.positions import position_fields
from iort_contract.catalog.derived import registered_vehicle
from iort_contract.catalog.streams import ACCOUNT_STREAM, OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.dynamodb import plain, starting_between
from iort_contract.limits import MAX_BATCH_SPAN_US
from iort_contract.messages.analysis import DriveKey
from iort_contract.messages.batch import BatchId
from iort_contract.messages.insights import Extent
from iort_contract.messages.page import Run, RunPart, RunsAnswer, RunState
from iort_contract.tables import RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.accounts import SILENT_US, Account, last_of
from iort_station.data.queries import has_fraction, query
from iort_station.data.recorded import Recorded
from iort_station.fleet import registry

_READERS = 8
# The runs that an overview counts.
_MOST_RUNS = 100


class Part(NamedTuple):
    """A stream's first and last batch of a run, or of all runs; and the time just after the last sample."""

    first: BatchId
    last: BatchId
    to_us: int

    @property
    def extent(self) -> Extent:
        return {"from_us": self.first.t_us, "to_us": self.to_us}


class Report(NamedTuple):
    """The last report of a run, and the batches that have it."""

    part: Part
    account: Account

    @property
    def state(self) -> RunState:
        """How the run went on."""
        if self.account.ended:
            return "ended"
        return "running" if time.time() * 1e6 - self.account.received_us < SILENT_US else "cut off"


def runs(
    cloud: Cloud,
    robot: str,
    *,
    streams: Sequence[str] | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    count: int = 50,
    origin: Origin | None = None,
) -> RunsAnswer:
    """The newest ``count`` runs of a robot that recorded in a range, with the extent of its streams.

    ``origin`` learns which hours of the archive were read.

    ``streams`` None means all but the agent's own. A run that began before the range is given whole, and one
    that goes on after its end up to there. Raises `StationError` for an unknown robot.
    """
    if streams is None:
        streams = [name for name in inventory.check_recorded(cloud, robot) if name not in OWN_STREAMS]
    reports, *readers = (_Reader(cloud, robot, name, origin=origin) for name in (ACCOUNT_STREAM, *streams))

    def parts(reader: _Reader) -> list[Part]:
        return list(islice(reader.runs(start_us, end_us), count + 1))

    with ThreadPoolExecutor(_READERS) as pool:
        wholes = pool.map(_Reader.whole, readers)
        reported, *recorded = pool.map(parts, [reports, *readers])
        accounts = {last.part.last.boot: last for last in pool.map(reports.report, reversed(reported))}
    extents = {stream: whole.extent for stream, whole in zip(streams, wholes, strict=True) if whole}
    entries = _by_run(dict(zip(streams, recorded, strict=True)), accounts)
    entries.sort(key=lambda run: run["to_us"], reverse=True)
    next_batch = None if end_us is None else reports.after(end_us)
    for i, run in enumerate(entries):
        if next_batch is not None and run["run"] == next_batch.boot:
            # It goes on, and the report of its end is not read.
            run["state"] = "unknown"
        elif i and run["state"] == "running":
            run["state"] = "cut off"
    return {"runs": entries[:count], "older": len(entries) > count, "streams": extents}


def reports(cloud: Cloud, robot: str, start_us: int | None, end_us: int | None) -> dict[str, Report]:
    """The last report in a range of each run that sent one there, by the run's name."""
    reader = _Reader(cloud, robot, ACCOUNT_STREAM)
    found: dict[str, Report] = {}
    for part in reader.runs(start_us, end_us):
        boot = part.last.boot
        # Runs at the same time come in several parts, the newest first.
        if boot in found:
            newest = found[boot]
            found[boot] = newest._replace(part=newest.part._replace(first=part.first))
        else:
            found[boot] = reader.report(part)
    return found


@dataclass(frozen=True)
class StreamOverview:
    """A stream: its extent, its newest runs, and the fields of its newest batch with their units.

    ``older`` tells whether there are more runs than those counted.
    """

    stream: str
    extent: Extent
    runs: int
    older: bool
    fields: Mapping[str, str]


def overview(cloud: Cloud, robot: str, *, origin: Origin | None = None) -> list[StreamOverview]:
    """The robot's streams, the agent's own ones last; at most `_MOST_RUNS` runs are counted.

    It reads the newest batch of each stream, and for each run what `runs` reads. ``origin`` learns
    which hours of the archive that was. Raises `StationError` for an unknown robot.
    """
    streams = sorted(inventory.check_recorded(cloud, robot), key=lambda name: (name in OWN_STREAMS, name))
    answer = runs(cloud, robot, streams=streams, count=_MOST_RUNS, origin=origin)
    kinds = {kind.stream: kind for _, kind in inventory.types_of(cloud, robot)}

    def described(stream: str) -> StreamOverview:
        newest = inventory.newest_block(cloud, robot, stream)
        kind = kinds.get(stream) or inventory.assumed_kind(stream, newest.columns.keys())
        kind = None if stream in {VESC_STREAM, *OWN_STREAMS} else kind
        ros2 = has_fraction(newest)
        return StreamOverview(
            stream,
            answer["streams"][stream],
            sum(stream in run["streams"] for run in answer["runs"]),
            answer["older"],
            {name: inventory.unit(stream, name, ros2=ros2, kind=kind) for name in newest.columns},
        )

    return [described(stream) for stream in streams if stream in answer["streams"]]


def _by_run(recorded: Mapping[str, list[Part]], accounts: Mapping[str, Report]) -> list[Run]:
    """The runs with what each recorded of every stream, in no order."""
    entries = {
        boot: _run(boot, report.part, report)
        for boot, report in accounts.items()
        # A run with samples is shown for its samples' times, which may be those of a recording.
        if not any(stream.stored for stream in report.account.streams.values())
    }
    for stream, parts in recorded.items():
        for part in parts:
            boot = part.last.boot
            reported = accounts.get(boot)
            run = entries.setdefault(boot, _run(boot, part, reported))
            run["from_us"] = min(run["from_us"], part.first.t_us)
            run["to_us"] = max(run["to_us"], part.to_us)
            counted = None if reported is None else reported.account.streams.get(stream)
            entry: RunPart = {
                **part.extent,
                "batches": part.last.seq - part.first.seq + 1,
                "samples": None if counted is None else counted.stored,
            }
            run["streams"].setdefault(stream, entry)
    return list(entries.values())


def _run(boot: str, part: Part, reported: Report | None) -> Run:
    young = time.time() * 1e6 - part.to_us < SILENT_US
    return {
        **part.extent,
        "run": boot,
        "state": ("running" if young else "unknown") if reported is None else reported.state,
        "lost": 0 if reported is None else reported.account.lost,
        "streams": {},
    }


class _Reader(Recorded):
    """Reads single batches of a stream."""

    def whole(self) -> Part | None:
        """All that is stored of the stream; None if nothing is."""
        first, last = self.after(None), self.before(None)
        return None if first is None or last is None else Part(first, last, self._end_us(last))

    def runs(self, start_us: int | None, end_us: int | None) -> Iterator[Part]:
        """What each run recorded in a range, newest first; the first one may begin before the range."""
        last = self.before(end_us)
        while last is not None and (start_us is None or last.t_us + MAX_BATCH_SPAN_US > start_us):
            first, before = self._first_of(last)
            yield Part(first, last, self._end_us(last))
            last = before

    def report(self, part: Part) -> Report:
        """The last report of a run."""
        # An agent that does not batch sends a report in several messages.
        keys = starting_between(part.last.t_us - MAX_BATCH_SPAN_US, part.last.t_us)
        items = chain.from_iterable(self.items(keys, (*ATTRIBUTES, RECEIVED_MS)))
        return Report(part, last_of(map(plain, items)).get(part.last.boot, Account()))

    def _first_of(self, last: BatchId) -> tuple[BatchId, BatchId | None]:
        """The first batch of the run of ``last``, and the one before it, of another run."""
        known, other_us = last, None
        jump_us = (last.seq + 1) * MAX_BATCH_SPAN_US
        while other_us is None or known.t_us - other_us > 1:
            if other_us is None:
                at_us, jump_us = known.t_us - jump_us, 2 * jump_us
            else:
                at_us = (other_us + known.t_us + 1) // 2
            batch = self.after(max(0, at_us)) or known
            if batch.boot != last.boot:
                other_us = batch.t_us
                continue
            before = self.before(batch.t_us)
            if before is None or before.boot != last.boot:
                return batch, before
            known = before
        return known, self.before(known.t_us)

    def _end_us(self, last: BatchId) -> int:
        times_us = self.block(last, lambda _name: False).times_us
        return int(times_us[-1] if len(times_us) else last.t_us) + 1


class RunLaps(NamedTuple):
    """The laps of a run, or in the part of it that a range has."""

    run: str
    start_us: int
    end_us: int
    mined: Mined


def laps_of_runs(
    cloud: Cloud,
    robot: str,
    start_us: int | None,
    end_us: int | None,
    *,
    count: int,
    progress: PageProgress | None = None,
) -> Iterator[RunLaps]:
    """The laps of the newest ``count`` runs in a range, the oldest first."""
    newest = runs(cloud, robot, start_us=start_us, end_us=end_us, count=count)["runs"]
    for run in reversed(newest):
        first_us = max(run["from_us"], start_us or 0)
        last_us = run["to_us"] if end_us is None else min(run["to_us"], end_us)
        mined = laps_within(cloud, robot, first_us, last_us, progress=progress)
        yield RunLaps(run["run"], first_us, last_us, mined)


def laps_within(
    cloud: Cloud,
    robot: str,
    start_us: int,
    end_us: int,
    *,
    progress: PageProgress | None = None,
    most: int | None = None,
) -> Mined:
    """The laps from ``start_us`` to before ``end_us``; raises `StationError` over ``most`` values."""
    streams: dict[str, Block] = {}
    notes: dict[str, str] = {}
    for name in inventory.check_recorded(cloud, robot):
        if name in OWN_STREAMS or not _tells_laps(name, inventory.newest_block(cloud, robot, name)):
            continue
        read = query(cloud, robot, name, start_us, end_us, progress=progress, most=most)
        streams[name] = Block(read.times_us, dict(read.columns))
        if read.refused:
            notes[f"{name} items"] = f"{read.refused:,} cannot be read; the first: {read.reason}"
    vehicle = registered_vehicle(registry.find(cloud, robot) or {})
    drive = build(DriveKey(robot, start_us, ""), streams, vehicle)
    mined = laps.mine(with_gain(drive))
    return replace(mined, missing={**notes, **mined.missing})


def _tells_laps(stream: str, block: Block) -> bool:
    """Whether a stream like this one has a position or a speed."""
    return position_fields(block.columns) is not None or motion_of(stream, block.columns) is not None
