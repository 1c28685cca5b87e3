"""What is stored of a robot: its streams, with their fields, runs and times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from iort_analysis.archive.stored import Origin
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.analysis.insights import Extent
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.queries import has_fraction
from iort_station.data.runs import runs
from iort_station.data.units import unit

_MOST_RUNS = 100


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
    found = runs(cloud, robot, streams=streams, count=_MOST_RUNS, origin=origin)
    kinds = {kind.stream: kind for _, kind in inventory.types_of(cloud, robot)}
    told = []
    for stream in streams:
        if stream not in found["streams"]:
            continue
        newest = inventory.newest_block(cloud, robot, stream)
        kind = kinds.get(stream) or inventory.assumed_kind(stream, newest.columns.keys())
        kind = None if stream in {VESC_STREAM, *OWN_STREAMS} else kind
        ros2 = has_fraction(newest)
        told.append(
            StreamOverview(
                stream,
                found["streams"][stream],
                sum(stream in run["streams"] for run in found["runs"]),
                found["older"],
                {name: unit(stream, name, ros2=ros2, kind=kind) for name in newest.columns},
            )
        )
    return told
