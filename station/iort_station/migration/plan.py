"""What a move is about to do: whether the two sides fit together, and what each robot has to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from iort_contract.tables import MOVED_FROM
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.recorded import archive_of, topic_of
from iort_station.errors import StationError
from iort_station.fleet import files, registry
from iort_station.fleet.files import StoredFile

# What a move reads and writes.
_NEEDED = ("TelemetryTable", "ArchiveTable", "RobotsTable", "FindingsTable", "QuarantineTable", "FilesBucket")


@dataclass(frozen=True)
class Plan:
    """What the source has of a robot, and how it is registered. ``files`` are those that the target lacks."""

    robot: str
    registered: str
    streams: Sequence[str]
    hours: int
    files: Sequence[StoredFile]
    files_there: int

    @property
    def files_bytes(self) -> int:
        """The size of the files to copy."""
        return sum(one.size for one in self.files)


def check(source: Cloud, target: Cloud) -> None:
    """Raise `StationError` unless robots can be moved between these deployments."""
    if source.namespace != target.namespace:
        raise StationError(
            f"both deployments must have one namespace, got {source.namespace} and {target.namespace}: "
            "it is part of every topic"
        )
    if _place(source) == _place(target):
        raise StationError("the target is the source itself")
    _check_stacks("source", source)
    _check_stacks("target", target)


def _check_stacks(side: str, cloud: Cloud) -> None:
    try:
        for name in _NEEDED:
            cloud.output("storage", name)
    except StationError as error:
        raise StationError(f"the {side}: {error}") from error


def _place(cloud: Cloud) -> tuple[str, ...]:
    """Where a deployment is. Two profiles may be of one account."""
    if cloud.endpoint_url is not None:
        return (cloud.endpoint_url,)
    return cloud.client("sts").get_caller_identity()["Account"], cloud.region_name or ""


def origin(cloud: Cloud) -> str:
    """The name of a deployment in the rows of robots that came from it: no two buckets have one name."""
    return cloud.output("storage", "FilesBucket")


def plan(source: Cloud, target: Cloud, names: Sequence[str], *, same_robots: bool = False) -> list[Plan]:
    """What there is to move of these robots.

    Raises `StationError` for names that both sides have registered without a move: they may be two robots.
    With ``same_robots`` they are the same ones.
    """
    strangers = [] if same_robots else [name for name in names if _is_stranger(source, target, name)]
    if strangers:
        raise StationError(
            f"both sides have registered {', '.join(strangers)}, and not by a move, so these may be other "
            "robots: rename or remove them on one side; --same-robots if they are the same"
        )
    return [_of(source, target, robot) for robot in names]


def _is_stranger(source: Cloud, target: Cloud, robot: str) -> bool:
    here, there = registry.find(source, robot), registry.find(target, robot)
    if here is None or there is None:
        return False
    # A robot may come back, or both may have it from a third one.
    ours, theirs = ({origin(one), row.get(MOVED_FROM)} for one, row in ((source, here), (target, there)))
    return not (ours & theirs) - {None}


def _registered(source: Cloud, target: Cloud, robot: str) -> str:
    if registry.find(source, robot) is None:
        return "removed here, its recordings move"
    return "new in the target" if registry.find(target, robot) is None else "is in the target"


def _of(source: Cloud, target: Cloud, robot: str) -> Plan:
    streams = inventory.known(source, robot)
    there = {(one.key, one.size) for one in files.listed(target, robot)}
    here = list(files.listed(source, robot))
    lacking = [one for one in here if (one.key, one.size) not in there]
    hours = sum(1 for stream in streams for _ in archive_of(source, topic_of(source, robot, stream)).rows())
    return Plan(
        robot=robot,
        registered=_registered(source, target, robot),
        streams=streams,
        hours=hours,
        files=lacking,
        files_there=len(here) - len(lacking),
    )
