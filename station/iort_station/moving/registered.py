"""Moves a robot's registration: row, thing with its tags, desired settings; and gives it a new certificate.

Until the robot has connected to the target, the source's values replace the target's. Then the target's stay.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from iort_contract.tables import (
    ADMISSION,
    ADMITTED_CERTIFICATE,
    ALERT_PREFIX,
    ASKED_PREFIX,
    CONNECTED_MS,
    DAYS,
    MOVED_FROM,
    OVER_SHARE,
    PRESENCE,
    ROBOT,
    SERIAL,
    STREAMS,
)
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import identity, registry, robots
from iort_station.fleet.identity import Bundle
from iort_station.moving.plan import origin

# What a registry's row says of the deployment and not of the robot.
_STAYS = frozenset({ROBOT, MOVED_FROM, *DAYS, *PRESENCE, *ADMISSION}) - {SERIAL}
_COUNTERS = (ALERT_PREFIX, ASKED_PREFIX)


def copy(source: Cloud, target: Cloud, robot: str) -> bool:
    """Register a robot in the target, or bring its registration there up to date; returns whether it was new.

    A robot that the source has removed stays removed.
    """
    row, there = registry.find(source, robot), registry.find(target, robot)
    if row is None:
        return False
    carried = _carried(row)
    if there is None:
        registry.enter(target, robot, {**carried, MOVED_FROM: origin(source)})
    elif MOVED_FROM not in there:
        registry.set_moved(target, robot, origin(source))
    if there is None or CONNECTED_MS not in there:
        numbers = {name: float(value) for name, value in carried.items() if isinstance(value, Decimal)}
        if there is not None and any(there.get(name) != carried[name] for name in numbers):
            registry.set_vehicle(target, robot, numbers)
        _copy_thing(source, target, robot)
        _copy_settings(source, target, robot)
    return there is None


def _carried(row: Mapping[str, Any]) -> dict[str, Any]:
    kept = {
        name: value
        for name, value in row.items()
        if name not in _STAYS and not name.startswith(_COUNTERS) and value is not None
    }
    # DynamoDB has no empty set.
    return {**kept, **({STREAMS: set(kept[STREAMS])} if STREAMS in kept else {})}


def _copy_thing(source: Cloud, target: Cloud, robot: str) -> None:
    """Make a thing with the tags and the serial number that the source's has."""
    attributes = robots.attributes(source, robot)
    if attributes is not None:
        robots.make_thing(target, robot, attributes)


def _copy_settings(source: Cloud, target: Cloud, robot: str) -> None:
    """Desire in the target what the source desires, also an emergency stop."""
    wanted, found = _desired(source, robot), _desired(target, robot)
    if wanted != found:
        state = json.dumps({"state": {"desired": _change(found, wanted)}})
        target.client("iot-data").update_thing_shadow(thingName=robot, shadowName=SHADOW, payload=state)


def _desired(cloud: Cloud, robot: str) -> dict[str, Any]:
    data = cloud.client("iot-data")
    try:
        answer = data.get_thing_shadow(thingName=robot, shadowName=SHADOW)
    except data.exceptions.ResourceNotFoundException:
        return {}
    desired: dict[str, Any] = json.loads(answer["payload"].read()).get("state", {}).get("desired") or {}
    # Each cloud says itself what is over a robot's share of it.
    desired.pop(OVER_SHARE, None)
    return desired


def _change(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """The change of a shadow that makes the new document of the old one; null removes."""
    changed: dict[str, Any] = dict.fromkeys(old.keys() - new.keys())
    for name, value in new.items():
        before = old.get(name)
        changed[name] = (
            _change(before, value) if isinstance(value, dict) and isinstance(before, dict) else value
        )
    return changed


def equip(target: Cloud, robot: str, bundles: Path) -> bool:
    """Make a certificate for a robot in the target, in the bundle ``bundles/<robot>``; False if it has one.

    A robot that has claimed its name, or has connected, needs none. An interrupted call is repeated whole.
    Raises `StationError` if the folder has the bundle of another cloud.
    """
    row = registry.find(target, robot)
    if row is None or ADMITTED_CERTIFICATE in row or CONNECTED_MS in row:
        return False
    bundle = Bundle(robot, bundles / robot)
    if bundle.config.exists():
        if _is_of(target, bundle):
            return False
        raise StationError(f"{bundle.folder} is a bundle of another cloud: give another folder for --bundles")
    robots.equip(target, bundle)
    return True


def _is_of(cloud: Cloud, bundle: Bundle) -> bool:
    """Whether the bundle's certificate is one that the robot has in this cloud."""
    try:
        named = yaml.safe_load(bundle.config.read_text())["certificate"]
        found = identity.fingerprint((bundle.folder / named).read_text())
    except (KeyError, OSError, TypeError, ValueError, yaml.YAMLError):
        return False
    return found in {one.id for one in identity.certificates(cloud, bundle.robot)}
