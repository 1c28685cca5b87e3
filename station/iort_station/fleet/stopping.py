"""The emergency stop: a robot's setting `MOTION_STOPPED`, which it keeps until somebody releases it."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.messages import shadow
from iort_contract.messages.commands import NO_MOTION, DriveLimits
from iort_contract.messages.video import VideoTerms
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.control import read

_T = TypeVar("_T")
# A fleet is stopped at once, not robot by robot.
_AT_ONCE = 32


class Motion(NamedTuple):
    """Whether a robot may move: the stop as it is asked for, as the robot has confirmed it (None before it
    does), and why the robot rejected a stop or a release. A rejected stop is not asked for: it holds nothing.
    ``drive`` is None if a stick cannot drive it. ``stoppable`` tells whether a stop ends its motion; None
    before the robot has said so. ``alone`` is a stop that the release of the fleet does not end. ``by`` is
    who stopped it, or else released it last. ``video`` is what its camera shows; None without one."""

    asked: bool
    stopped: bool | None
    reason: str
    drive: DriveLimits | None
    stoppable: bool | None = None
    alone: bool = False
    by: shadow.Pressed | None = None
    video: VideoTerms | None = None

    @property
    def stands(self) -> bool:
        """Whether a stop holds, by the robot's own word."""
        return self.stopped is True and self.stoppable is not False

    @property
    def why_not(self) -> str:
        """Why a stop may not stop it, for a human; empty if it does."""
        if self.stoppable is None:
            return "it has not said whether a stop ends its motion: it has not run yet, or has an older agent"
        return "" if self.stoppable else f"a stop does nothing there: {NO_MOTION}"


def motion(cloud: Cloud, robots: Iterable[str]) -> dict[str, Motion]:
    """Each robot's, by its name."""
    return dict(_each(cloud, robots, lambda robot: _motion(cloud, robot)))


def stop(cloud: Cloud, robots: Iterable[str], *, by: str, fleet: bool = False) -> dict[str, str]:
    """Stop robots without waiting for them, nor for a reading; `motion` tells what they have confirmed.

    Robots that are not connected stop before they take a command. Every robot is tried. Returns why, for
    each one for which it failed. ``by`` is who stops them; ``fleet`` is a stop that the release of the fleet
    ends. Whether the names are registered is for `take_back` to see, after the stop.
    """
    change = shadow.encode_stop(_pressed(by), fleet=fleet)
    return _tried(cloud, robots, lambda robot: _change(cloud, robot, change))


def take_back(cloud: Cloud, robots: Iterable[str]) -> dict[str, str]:
    """Undo the stop of names that nobody has registered; returns why, by name. A registry that does not
    answer takes nothing back."""

    def look(robot: str) -> str:
        try:
            if registry.find(cloud, robot) is not None:
                return ""
            data = cloud.client("iot-data")
            with contextlib.suppress(data.exceptions.ResourceNotFoundException):
                data.delete_thing_shadow(thingName=robot, shadowName=SHADOW)
            return str(registry.not_registered(cloud, robot))
        except (BotoCoreError, ClientError, StationError):
            return ""

    return {robot: reason for robot, reason in _each(cloud, robots, look).items() if reason}


def release(
    cloud: Cloud, robots: Iterable[str], *, by: str, fleet: bool = False, seen_ms: int | None = None
) -> dict[str, str]:
    """Release robots, however they were stopped; with ``fleet`` those that a stop of the fleet has stopped
    and nobody has stopped alone; as `stop`.

    ``seen_ms`` is the time of the newest stop that who releases knows of: one that was stopped again since
    then stays. None releases it in any case.
    """
    released = shadow.encode_release(_pressed(by))

    def change(robot: str) -> None:
        state = read(cloud.client("iot-data"), robot)
        stop = state.desired.stops.newest
        if seen_ms is not None and stop is not None and stop.t_ms > seen_ms:
            raise StationError(f"{stop.by} has stopped it again since")
        if not fleet or state.desired.stops.fleet is not None or state.stop_rejected:
            # With the version, so that a stop which somebody asks for at this moment is not lost.
            alone = fleet and state.desired.stopped_alone and not state.stop_rejected
            _change(
                cloud, robot, shadow.encode_fleet_released() if alone else released, version=state.version
            )

    return _changed(cloud, robots, change)


def repeat(cloud: Cloud, robots: Iterable[str]) -> None:
    """Change nothing: a robot that has missed a change learns from the next one that it has."""

    def change(robot: str) -> None:
        state = read(cloud.client("iot-data"), robot)
        stopped = state.desired.settings.get(shadow.MOTION_STOPPED)
        # With the version, so that no other change is undone.
        _change(cloud, robot, shadow.nested({shadow.MOTION_STOPPED: stopped}), version=state.version)

    _changed(cloud, robots, change)


def _pressed(by: str) -> shadow.Pressed:
    return shadow.Pressed(by, time.time_ns() // 1_000_000)


def _change(cloud: Cloud, robot: str, desired: Mapping[str, Any], version: int | None = None) -> None:
    document = {"state": {"desired": desired}, **({} if version is None else {"version": version})}
    data = cloud.client("iot-data")
    data.update_thing_shadow(thingName=robot, shadowName=SHADOW, payload=json.dumps(document))


def _changed(cloud: Cloud, robots: Iterable[str], change: Callable[[str], None]) -> dict[str, str]:
    wanted = list(robots)
    known = {str(row["robot"]) for row in registry.listed(cloud)}
    if strangers := sorted(set(wanted) - known):
        raise StationError(f"not registered: {', '.join(strangers)}; nothing is changed")
    return _tried(cloud, wanted, change)


def _tried(cloud: Cloud, robots: Iterable[str], change: Callable[[str], None]) -> dict[str, str]:
    def tried(robot: str) -> str:
        try:
            change(robot)
        except (BotoCoreError, ClientError, StationError) as error:
            return str(error)
        return ""

    return {robot: error for robot, error in _each(cloud, robots, tried).items() if error}


def _motion(cloud: Cloud, robot: str) -> Motion:
    state = read(cloud.client("iot-data"), robot)
    rejected = state.rejected().get(shadow.MOTION_STOPPED)
    stopped = state.reported.settings.get(shadow.MOTION_STOPPED)
    # A robot may also stand by its car.yaml, or since the shadow that asked for it was deleted.
    asked = state.desired.settings.get(shadow.MOTION_STOPPED, stopped) is True and not state.stop_rejected
    notes = state.desired.stops
    return Motion(
        asked=asked,
        stopped=stopped,
        reason=rejected.reason if rejected is not None else "",
        drive=state.reported.drive,
        stoppable=state.reported.moves,
        alone=asked and state.desired.stopped_alone,
        by=notes.newest if asked else notes.released,
        video=state.reported.video,
    )


def _each(cloud: Cloud, robots: Iterable[str], work: Callable[[str], _T]) -> Mapping[str, _T]:
    # Threads share a client, and must not make it at the same time.
    cloud.client("iot-data")
    names = sorted(set(robots))
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return dict(zip(names, pool.map(work, names), strict=True))
