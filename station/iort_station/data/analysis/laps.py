"""The laps of a robot's runs, found in what it recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from iort_analysis.archive.stored import PageProgress
from iort_analysis.drives.building import build
from iort_analysis.drives.motion import motion_of
from iort_analysis.mining import laps
from iort_analysis.mining.gain import with_gain
from iort_analysis.results import Mined
from iort_analysis.samples.blocks import Block
from iort_analysis.samples.positions import position_fields
from iort_contract.catalog.derived import registered_vehicle
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.messages.analysis.findings import DriveKey
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.queries import query
from iort_station.data.runs import runs
from iort_station.fleet import registry


class RunLaps(NamedTuple):
    """What was found in a run, or in the part of it that a range has."""

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
    found = runs(cloud, robot, start_us=start_us, end_us=end_us, count=count)["runs"]
    for run in reversed(found):
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
