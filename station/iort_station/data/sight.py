"""What the driver of a robot with video saw: each motion command beside the picture that it names.

The stream `drive` has a sample of each command, with the number of the newest picture on the driver's screen
and how old it was when the command came. The stream `video` has a sample of each picture that was shown, at
its capture time. Every run of the agent has numbers of its own, so both are joined by run and number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iort_analysis.archive.stored import PageProgress
from iort_contract.catalog.streams import DRIVE_STREAM, VIDEO_STREAM
from iort_contract.dynamodb import plain, with_samples_between
from iort_contract.limits import ContractError, Value
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.messages.commands import NO_PICTURE, PICTURE_LATE, STOPPED
from iort_contract.tables import BATCH
from iort_contract.topics import ACCEPTED
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.recorded import Recorded

# How long before a command a picture that it names may have been captured. A robot knows the age of younger
# ones alone: `iort_agent.video.KEPT_S`.
_BEFORE_US = 11_000_000


@dataclass(frozen=True)
class Seen:
    """A motion command, and what its driver saw.

    ``t_us`` is when it came, by the robot's clock. ``ends``: it ended the lease, for which no picture is
    needed. ``speed`` and ``steering`` are what the robot was told; None if it was refused, or if no stick
    drives this command. ``frame`` is the picture's number, ``captured_us`` when it was captured, by the
    robot's clock, and ``age_ms`` its age when the command came: each None if it is not known."""

    t_us: int
    run: str
    session: str
    by: str | None
    seq: int
    outcome: str
    ends: bool
    speed: float | None
    steering: float | None
    frame: int | None
    captured_us: int | None
    age_ms: float | None
    blind: bool

    @property
    def by_sight(self) -> bool:
        """Whether the robot took it for its picture."""
        return self.outcome == ACCEPTED and self.frame is not None and not (self.blind or self.ends)


@dataclass(frozen=True)
class Sight:
    """The commands of a range, in order of time. ``refused`` counts what is stored and cannot be read;
    ``reason`` names the first."""

    commands: Sequence[Seen]
    refused: int = 0
    reason: str = ""

    def figures(self) -> dict[str, Any]:
        """Figures of all commands, for JSON. Those of the age are of the commands that the robot took for
        their pictures; None without one."""
        outcomes = Counter(one.outcome for one in self.commands)
        ages = [one.age_ms for one in self.commands if one.by_sight and one.age_ms is not None]
        middle, most = (round(float(np.percentile(ages, share)), 1) if ages else None for share in (50, 95))
        return {
            "commands": len(self.commands),
            "with_picture": sum(one.frame is not None for one in self.commands),
            "by_sight": sum(one.by_sight for one in self.commands),
            "age_p50_ms": middle,
            "age_p95_ms": most,
            "age_longest_ms": max(ages, default=None),
            "blind": sum(one.blind for one in self.commands),
            "ends": sum(one.ends for one in self.commands),
            "picture_late": outcomes[PICTURE_LATE],
            "no_picture": outcomes[NO_PICTURE],
            "not_recorded": sum(one.frame is not None and one.captured_us is None for one in self.commands),
        }


def sight(
    cloud: Cloud,
    robot: str,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    progress: PageProgress | None = None,
) -> Sight:
    """The motion commands that a robot recorded from ``start_us`` (inclusive) to ``end_us`` (exclusive).

    Of refused ones the robot records ten a second at most. Raises `StationError` for an unknown robot, and
    for one that has recorded no command.
    """
    commands, pictures = (Recorded(cloud, robot, stream) for stream in (DRIVE_STREAM, VIDEO_STREAM))
    told = [
        (batch.boot, t_us, sample)
        for batch in _batches(commands, start_us, end_us, progress)
        for t_us, sample in _samples(batch)
        if (start_us is None or start_us <= t_us) and (end_us is None or t_us < end_us)
        # It tells of the end of a lease, and not of a command.
        if sample.get("outcome") != STOPPED
    ]
    if not told and not commands.refused.count:
        inventory.check_there(cloud, robot, DRIVE_STREAM)
    captured: dict[tuple[str, int], int] = {}
    if any(sample.get("frame") is not None for _, _, sample in told):
        since_us = None if start_us is None else start_us - _BEFORE_US
        for batch in _batches(pictures, since_us, end_us, progress):
            for t_us, sample in _samples(batch):
                if (number := _whole(sample.get("frame"))) is not None:
                    captured[batch.boot, number] = t_us
    found = [_seen(run, t_us, sample, captured) for run, t_us, sample in told]
    refused = commands.refused.count + pictures.refused.count
    reason = commands.refused.reason or pictures.refused.reason
    return Sight(sorted(found, key=lambda one: one.t_us), refused, reason)


def _batches(
    recorded: Recorded, start_us: int | None, end_us: int | None, progress: PageProgress | None
) -> Iterator[Batch]:
    for items in recorded.items(with_samples_between(start_us, end_us), progress=progress):
        for item in items:
            try:
                batch = decode_batch(plain(item))
            except ContractError as error:  # noqa: PERF203 - each batch is refused by itself
                recorded.refused.add(error, item.get(BATCH, {}).get("S", ""))
            else:
                yield batch


def _samples(batch: Batch) -> Iterator[tuple[int, Mapping[str, Value]]]:
    for i, t_us in enumerate(batch.times_us):
        yield t_us, {name: column[i] for name, column in batch.columns.items()}


def _seen(run: str, t_us: int, sample: Mapping[str, Value], captured: Mapping[tuple[str, int], int]) -> Seen:
    frame, by, outcome = _whole(sample.get("frame")), sample.get("by"), str(sample.get("outcome"))
    return Seen(
        t_us,
        run,
        str(sample.get("session")),
        str(by) if by is not None else None,
        _whole(sample.get("seq")) or 0,
        outcome,
        # Any other motion leaves a lease.
        outcome == ACCEPTED and not sample.get("lease_left_ms"),
        _number(sample.get("speed")),
        _number(sample.get("steering")),
        frame,
        None if frame is None else captured.get((run, frame)),
        _number(sample.get("frame_age_ms")),
        sample.get("blind") is True,
    )


def _number(value: Value) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _whole(value: Value) -> int | None:
    number = _number(value)
    return None if number is None else int(number)
