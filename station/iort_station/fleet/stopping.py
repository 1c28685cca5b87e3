"""The emergency stop: a robot's setting `MOTION_STOPPED`, which it keeps until somebody releases it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.messages.driving import DriveLimits
from iort_contract.messages.settings import MOTION_STOPPED
from iort_contract.messages.shadow import nested
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.shadow import read

_T = TypeVar("_T")
# A fleet is stopped at once, not robot by robot.
_AT_ONCE = 32


class Motion(NamedTuple):
    """Whether a robot may move: the stop as it is asked for, as the robot has confirmed it (None before it
    does), and why the robot rejected it. ``drive`` is None if a stick cannot drive it."""

    asked: bool
    stopped: bool | None
    reason: str
    drive: DriveLimits | None


def motion(cloud: Cloud, robots: Iterable[str]) -> dict[str, Motion]:
    """Each robot's, by its name."""
    return dict(_each(cloud, robots, lambda robot: _motion(cloud, robot)))


def stop(cloud: Cloud, robots: Iterable[str], *, stopped: bool) -> dict[str, str]:
    """Stop robots, or release them, without waiting for them; `motion` tells what they have confirmed.

    Robots that are not connected stop before they take a command. Every robot is tried. Returns why, for
    each one for which it failed. Raises `StationError` for a robot that is not registered, before any is
    tried.
    """
    wanted = list(robots)
    known = {str(row["robot"]) for row in registry.listed(cloud)}
    if strangers := sorted(set(wanted) - known):
        raise StationError(f"not registered: {', '.join(strangers)}; nothing is changed")
    payload = json.dumps({"state": {"desired": nested({MOTION_STOPPED: stopped})}})
    data = cloud.client("iot-data")

    def change(robot: str) -> str:
        try:
            data.update_thing_shadow(thingName=robot, shadowName=SHADOW, payload=payload)
        except (BotoCoreError, ClientError) as error:
            return str(error)
        return ""

    return {robot: error for robot, error in _each(cloud, wanted, change).items() if error}


def _motion(cloud: Cloud, robot: str) -> Motion:
    state = read(cloud.client("iot-data"), robot)
    rejected = state.rejected().get(MOTION_STOPPED)
    stopped = state.reported.settings.get(MOTION_STOPPED)
    return Motion(
        # A robot may also stand by its car.yaml, or since the shadow that asked for it was deleted.
        asked=state.desired.settings.get(MOTION_STOPPED, stopped) is True,
        stopped=stopped,
        reason=rejected.reason if rejected is not None else "",
        drive=state.reported.drive,
    )


def _each(cloud: Cloud, robots: Iterable[str], work: Callable[[str], _T]) -> Mapping[str, _T]:
    # Threads share a client, and must not make it at the same time.
    cloud.client("iot-data")
    names = sorted(set(robots))
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return dict(zip(names, pool.map(work, names), strict=True))
