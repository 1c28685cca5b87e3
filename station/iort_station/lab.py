"""The library's one object, a `Lab`: a deployment's robots, and what is recorded and known of them.

A time is an integer of microseconds since the epoch, a datetime, or a text as `iort` takes it: ``-10m``,
``20:04``, ISO 8601. A range includes its start and excludes its end; None is open. What is returned has times
as integers, in microseconds since the epoch, UTC; their names end in ``_us``.

Every method raises `StationError`, the root of the library's errors: for an unknown robot or stream, with the
nearest names, and for a cloud that refuses or cannot be reached. `UsageError` is one of them, for what nobody
could answer: a text that is no time, or a condition that cannot be read.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from botocore.exceptions import BotoCoreError, ClientError
from numpy.typing import NDArray

from iort_analysis import AnalysisError
from iort_analysis.mining.laps import compare
from iort_contract import tables
from iort_contract.catalog.analysis import LAPS_TABLE, PLACES_TABLE
from iort_contract.limits import DEFAULT_NAMESPACE, ContractError, Value
from iort_contract.messages.analysis import Estimate, Finding
from iort_contract.ros.message import RosType
from iort_station.cloud import Cloud
from iort_station.data import findings as stored
from iort_station.data import incidents as recorder
from iort_station.data import inventory, ros_messages
from iort_station.data import runs as recorded
from iort_station.data.export import Export
from iort_station.data.queries import Result, query
from iort_station.data.recorded import Selection, select
from iort_station.errors import StationError, UsageError
from iort_station.fleet import files, registry
from iort_station.operations.verdict import Verdict, verdict
from iort_station.times import Time, time_us

__all__ = [
    "Estimate",
    "Finding",
    "Incident",
    "Lab",
    "Laps",
    "Message",
    "Result",
    "Robot",
    "Run",
    "StationError",
    "Stream",
    "UsageError",
    "Verdict",
    "connect",
]


def connect(
    embedded: str | Path | None = None,
    *,
    namespace: str = DEFAULT_NAMESPACE,
    profile: str | None = None,
    region: str | None = None,
) -> Lab:
    """The deployment that `iort` means here: the embedded cloud of ``embedded``, its file ``cloud.json``; or
    one that runs here; or else AWS, in a ``region`` with the credentials of a ``profile``.

    Raises `StationError` if none runs and AWS' credentials are missing.
    """
    with one_root():
        return Lab(
            Cloud.find(
                namespace=namespace,
                profile=profile,
                region=region,
                local=embedded is not None,
                embedded=None if embedded is None else Path(embedded),
            )
        )


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A registered robot. ``online`` says whether it is connected, ``since_us`` since when it is or is not;
    None if it never was. ``speed_to_erpm_gain``, in erpm per m/s, is None if no speed can be told in m/s."""

    name: str
    online: bool
    since_us: int | None
    speed_to_erpm_gain: float | None


@dataclass(frozen=True, kw_only=True)
class Stream:
    """A stream of a robot, from its first sample at ``from_us`` to just after its last, ``to_us``.

    ``runs`` counts the newest runs with samples, at most 100. ``fields`` has the unit of each field of the
    newest batch; empty if unknown.
    """

    robot: str
    name: str
    from_us: int
    to_us: int
    runs: int
    fields: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run of a robot's agent, from its first sample at ``from_us`` to just after its last, ``to_us``.

    ``state`` is "running", "ended", "cut off" if it did not end properly, or "unknown". ``lost`` counts the
    messages and samples that the agent could not record. ``streams`` has ``from_us``, ``to_us``, ``batches``
    and ``samples`` of each stream; samples are None without a report of the agent.
    """

    robot: str
    id: str
    from_us: int
    to_us: int
    state: Literal["running", "ended", "cut off", "unknown"]
    lost: int
    streams: Mapping[str, Mapping[str, int | None]]


@dataclass(frozen=True, kw_only=True)
class Incident:
    """What a robot's recorder has kept of the window ``from_us`` to ``to_us``, in its newest ``state``, of
    ``changed_us``: "kept" on the robot, "uploaded", "notified", "over_budget" or "lost".

    ``trigger`` has the names of its triggers, separated by commas, and ``condition`` what they ask for.
    ``key`` is its MCAP file in the bucket, of so many ``bytes`` and ``messages``; ``missing`` counts messages
    of the window that are not in it. ``by`` and ``why`` are an operator's words, or the reason of a loss.
    """

    robot: str
    id: str
    trigger: str
    from_us: int
    to_us: int
    state: str
    changed_us: int
    condition: str
    why: str
    by: str
    key: str
    bytes: int
    messages: int
    missing: int


@dataclass(frozen=True, kw_only=True)
class Laps:
    """The laps of a run, searched from ``from_us`` to ``to_us``.

    ``columns`` has an array for each figure with a value for each lap: ``lap``, ``start_us``, ``time_s``,
    ``distance_m``, ``energy_wh``, ``mean_speed_mps``, ``best``, ``complete`` and others, whose names end with
    their units; it is empty if there are no laps, and ``missing`` then says why. ``estimates`` has what
    follows from them with its 90 % interval, such as ``lap_best_s``.
    """

    robot: str
    run: str
    from_us: int
    to_us: int
    columns: Mapping[str, NDArray[Any]]
    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    _places: Mapping[str, NDArray[Any]] = field(default_factory=dict, repr=False, compare=False)

    def compare(self, one: int, other: int) -> Mapping[str, NDArray[Any]]:
        """Two laps by their numbers, at places along the track: ``place_m``; ``delta_s``, how far the other
        is behind; and the speeds ``one_mps`` and ``other_mps``.

        Raises `UsageError` for laps that are not there.
        """
        if not self._places:
            reasons = "; ".join(self.missing.values()) or "this run has no laps"
            raise UsageError(f"no laps to compare: {reasons}")
        try:
            return compare(self._places, one, other)
        except AnalysisError as error:
            raise UsageError(str(error)) from error


@dataclass(frozen=True, kw_only=True)
class Message:
    """A ROS message as its publisher sent it, at ``time_us``: its bytes ``raw``, serialized as ROS 1 does, or
    in CDR if ``type`` has the form ``package/msg/Type``. ``definition`` is the type's text with all nested
    types; empty if the robot did not declare it."""

    robot: str
    stream: str
    time_us: int
    topic: str
    type: str
    definition: str
    raw: bytes = field(repr=False)

    def decode(self) -> dict[str, Value]:
        """The message as a flat sample, as queries have it: ``pose.position.x``, ``covariance.0``.

        The bytes of ``uint8[]`` and long arrays are left out. Raises `StationError` if the type cannot be
        decoded.
        """
        kind = _type(self.topic, self.type, self.definition)
        if kind.decoder is None:
            raise StationError(f"{self.type} cannot be decoded: {kind.error}")
        with one_root():
            return kind.decoder.decode(self.raw)


class Lab:
    """A deployment, from `connect`. One object may be used from several threads."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud = cloud

    def robots(self) -> list[Robot]:
        """The registered robots, by name."""
        with one_root():
            rows = {str(row[tables.ROBOT]): row for row in registry.listed(self._cloud)}
        return [_robot(name, rows[name]) for name in sorted(rows)]

    def streams(self, robot: str) -> list[Stream]:
        """The streams of a robot, the agent's own ones last. It reads some batches of each run."""
        with one_root():
            found = recorded.overview(self._cloud, robot)
        return [
            Stream(robot=robot, name=one.stream, **one.extent, runs=one.runs, fields=one.fields)
            for one in found
        ]

    def runs(
        self, robot: str, start: Time | None = None, end: Time | None = None, *, count: int = 50
    ) -> list[Run]:
        """The newest ``count`` runs of a robot's agent that recorded in a range, newest first. A run that
        began before the range is given whole. It reads some batches of each run, never all samples."""
        start_us, end_us = _range(start, end)
        _check_count(count)
        with one_root():
            found = recorded.runs(self._cloud, robot, start_us=start_us, end_us=end_us, count=count)["runs"]
        return [
            Run(
                robot=robot,
                id=one["run"],
                from_us=one["from_us"],
                to_us=one["to_us"],
                state=one["state"],
                lost=one["lost"],
                streams={name: {**part} for name, part in one["streams"].items()},  # type: ignore[dict-item]  # all are integers or None
            )
            for one in found
        ]

    def query(
        self,
        robot: str,
        stream: str,
        start: Time | None = None,
        end: Time | None = None,
        *,
        fields: Sequence[str] | None = None,
        where: str | None = None,
        every: str | None = None,
        most: int | None = None,
    ) -> Result:
        """The samples of a stream in order of time, from table and archive as one.

        ``fields`` and ``where``, a condition such as ``"speed_mps > 1.2 and fault_code == 0"``, may name the
        derived fields ``speed_mps`` and ``power_w``. ``every``, such as ``"1s"``, has samples averaged.

        Raises `StationError` for more values than ``most``, and for a field that no sample has.
        """
        with one_root():
            return query(
                self._cloud, robot, stream, start, end, fields=fields, where=where, every=every, most=most
            )

    def messages(
        self, robot: str, stream: str, start: Time | None = None, end: Time | None = None
    ) -> Iterator[Message]:
        """The ROS messages of a stream as they were published, in the order of their batches.

        What was uploaded beside a message, such as a camera's image, is in it again. Raises `StationError` at
        the end if stored items could not be read, or if the stream's samples are no ROS messages.
        """
        with one_root():
            selection = select(robot, stream, start, end)
        return self._messages(selection)

    def _messages(self, selection: Selection) -> Iterator[Message]:
        cloud, robot, stream = self._cloud, selection.robot, selection.stream
        with one_root():
            declared = ros_messages.types(cloud, robot)
            known = {name: kind for name, kind in declared.items() if kind.stream == stream}
            export = Export(cloud, selection, known, lambda key: files.content(cloud, key))
            count = 0
            for count, (t_us, name, raw) in enumerate(export.messages(), 1):  # noqa: B007 - counts an iterator
                kind = export.types[name]
                yield Message(
                    robot=robot,
                    stream=stream,
                    time_us=t_us,
                    topic=kind.topic,
                    type=kind.kind,
                    definition=kind.definition,
                    raw=raw,
                )
            if export.refused.count:
                reason = export.refused.reason
                raise StationError(
                    f"{export.refused.count:,} stored items cannot be read; the first: {reason}"
                )
            if not count and export.others:
                raise StationError(
                    f"the samples of {robot} {stream} are no ROS messages: `query` has their fields"
                )
            if not count:
                inventory.check_there(cloud, robot, stream)

    def incidents(
        self, robot: str | None = None, start: Time | None = None, end: Time | None = None
    ) -> list[Incident]:
        """The incidents whose window has a part in a range, the newest first; of all robots without one."""
        start_us, end_us = _range(start, end)
        with one_root():
            found = recorder.incidents(self._cloud, robot, start_us, end_us)
            self._check_robot(robot, found)
        return [Incident(robot=one.robot, changed_us=one.t_us, **vars(one.incident)) for one in found]

    def findings(
        self,
        robot: str | None = None,
        start: Time | None = None,
        end: Time | None = None,
        *,
        count: int | None = None,
    ) -> list[Finding]:
        """The newest ``count`` findings of the analysis about drives that begin in a range, the newest first;
        of all robots without one."""
        start_us, end_us = _range(start, end)
        _check_count(count)
        with one_root():
            found = stored.findings(self._cloud, robot, start_us, end_us, most=count)
            self._check_robot(robot, found)
        return found

    def laps(
        self, robot: str, start: Time | None = None, end: Time | None = None, *, count: int = 1
    ) -> list[Laps]:
        """The laps of the newest ``count`` runs in a range, the oldest run first. It reads their samples."""
        start_us, end_us = _range(start, end)
        _check_count(count)
        with one_root():
            found = list(recorded.laps_of_runs(self._cloud, robot, start_us, end_us, count=count))
        return [
            Laps(
                robot=robot,
                run=one.run,
                from_us=one.start_us,
                to_us=one.end_us,
                columns=one.mined.tables.get(LAPS_TABLE, {}),
                estimates=one.mined.estimates,
                missing=one.mined.missing,
                _places=one.mined.tables.get(PLACES_TABLE, {}),
            )
            for one in found
        ]

    def audit(self, robot: str, stream: str, start: Time | None = None, end: Time | None = None) -> Verdict:
        """The audit's word about a range of a stream: complete, incomplete or unknown, and why.

        It decodes the stored batches.
        """
        with one_root():
            selection = select(robot, stream, start, end)
            found = verdict(self._cloud, robot, stream, selection.start_us, selection.end_us)
            if not found.batches:
                inventory.check_there(self._cloud, robot, stream)
        return found

    def _check_robot(self, robot: str | None, found: Sequence[object]) -> None:
        if not found and robot is not None:
            registry.get(self._cloud, robot)


@contextmanager
def one_root() -> Iterator[None]:
    """Raise what AWS, the analysis or the contract raises as the library's error."""
    try:
        yield
    except ClientError as error:
        raise StationError(f"AWS refused a call: {error}") from error
    except BotoCoreError as error:
        raise StationError(f"AWS could not be called: {error}") from error
    except (AnalysisError, ContractError) as error:
        raise StationError(str(error)) from error


def _range(start: Time | None, end: Time | None) -> tuple[int | None, int | None]:
    now_us = time.time_ns() // 1000
    start_us, end_us = (None if each is None else time_us(each, now_us) for each in (start, end))
    if start_us is not None and end_us is not None and start_us > end_us:
        raise UsageError("the range ends before it starts")
    return start_us, end_us


def _check_count(count: int | None) -> None:
    if count is not None and count < 1:
        raise UsageError(f"count must be 1 or more, got {count}")


def _robot(name: str, row: Mapping[str, Any]) -> Robot:
    online = bool(row.get(tables.ONLINE))
    at_ms = row.get(tables.CONNECTED_MS if online else tables.DISCONNECTED_MS)
    return Robot(
        name=name,
        online=online,
        since_us=None if at_ms is None else int(at_ms) * 1000,
        speed_to_erpm_gain=float(row.get("speed_to_erpm_gain") or 0) or None,
    )


@lru_cache(maxsize=64)
def _type(topic: str, kind: str, definition: str) -> RosType:
    return RosType(topic, kind, "", definition)
