"""Robots as a fleet has them: added and removed with thing, certificate, policy and row; and their tags."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from iort_contract.catalog.car import KNOWN
from iort_contract.cloud import fleet_name
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import identity, registry
from iort_station.fleet.identity import Bundle, configure, write_bundle
from iort_station.fleet.registry import F1TENTH, listed

__all__ = ["F1TENTH", "Bundle", "add", "checked_vehicle", "configure", "listed", "remove"]

GAIN = "speed_to_erpm_gain"
# Values beyond these are typing errors.
_MOST, _LEAST = 1e9, 1e-9


def checked_vehicle(vehicle: Mapping[str, float]) -> dict[str, float]:
    """Return valid vehicle parameters; raises `UsageError`."""
    for name, value in vehicle.items():
        if name in KNOWN:
            _check_known(name, value)
            continue
        if name not in F1TENTH:
            allowed = ", ".join([*F1TENTH, *KNOWN])
            raise UsageError(f"vehicle parameter must be one of {allowed}, got {name}")
        # NaN fails every comparison.
        if not abs(value) <= _MOST or (name == GAIN and abs(value) < _LEAST):
            no_zero = " and not 0" if name == GAIN else ""
            raise UsageError(f"{name} must be a number from {-_MOST:g} to {_MOST:g}{no_zero}, got {value:g}")
    return dict(vehicle)


def _check_known(name: str, value: float) -> None:
    unit, _, least, most, whole = KNOWN[name]
    if not least <= value <= most or (whole and value != int(value)):
        kind = "whole number" if whole else "number"
        of = "" if unit == "1" else f" ({unit})"
        raise UsageError(f"{name} must be a {kind} from {least:g} to {most:g}{of}, got {value:g}")


def add(
    cloud: Cloud,
    robot: str,
    *,
    out: Path,
    vehicle: Mapping[str, float] = F1TENTH,
    settings: Mapping[str, Any] | None = None,
) -> Bundle:
    """Register a robot and write its bundle into ``out/<robot>``, readable only by the owner.

    Lambda 2 derives the speed from the ``vehicle`` parameters. ``settings`` are further settings for
    car.yaml; the default source is a simulated car.

    Raises `StationError` for an invalid name, a registered robot, and a deployment without the fleet stack.
    """
    registry.checked(robot)
    folder = out / robot
    if folder.exists() and any(folder.iterdir()):
        raise StationError(f"{folder} is not empty; its keys would be lost")
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    registry.enter(cloud, robot, vehicle)
    bundle = Bundle(robot, folder)
    equip(cloud, bundle, settings)
    return bundle


def equip(cloud: Cloud, bundle: Bundle, settings: Mapping[str, Any] | None = None) -> None:
    """Make a certificate for a registered robot, and write its bundle. Interrupted, it can be repeated."""
    # Create it before anything is registered, since it will hold the only copy of the private key.
    bundle.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    iot, robot = cloud.client("iot"), bundle.robot
    try:
        make_thing(cloud, robot, attributes(cloud, robot) or {"vehicle": "vesc"})
        new = identity.make_certificate(iot, robot)
        iot.attach_policy(policyName=fleet_name(cloud.namespace), target=new.arn)
        iot.attach_thing_principal(thingName=robot, principal=new.arn)
    except ClientError as error:
        raise StationError(
            f"robot {robot} is only partly registered; remove it and try again: {error}"
        ) from error
    write_bundle(cloud, bundle, new.pem, new.private_key_pem, settings or {})


def attributes(cloud: Cloud, robot: str) -> dict[str, str] | None:
    """The attributes of a robot's thing: its tags, and its serial number; None if it has no thing."""
    iot = cloud.client("iot")
    try:
        return dict(iot.describe_thing(thingName=robot).get("attributes", {}))
    except iot.exceptions.ResourceNotFoundException:
        return None


def make_thing(cloud: Cloud, robot: str, attributes: Mapping[str, str]) -> None:
    """Make a robot's thing with these attributes, or give them to the one that it has."""
    iot, fleet = cloud.client("iot"), fleet_name(cloud.namespace)
    given = dict(attributes)
    try:
        iot.create_thing(thingName=robot, thingTypeName=fleet, attributePayload={"attributes": given})
    except iot.exceptions.ResourceAlreadyExistsException:
        iot.update_thing(thingName=robot, attributePayload={"attributes": given, "merge": False})
    iot.add_thing_to_thing_group(thingGroupName=fleet, thingName=robot)


def remove(cloud: Cloud, robot: str) -> None:
    """Remove a robot: revoke its certificates, end its session, and delete certificates, shadow, thing and
    row. Its samples and files stay.

    Raises `StationError` if it is not registered.
    """
    registry.get(cloud, robot)
    # A claim must not get it a new certificate now.
    registry.close_name(cloud, robot)
    held = identity.certificates(cloud, robot)
    for certificate in held:
        identity.revoke_certificate(cloud, certificate)
    identity.end_session(cloud, robot)
    for certificate in held:
        identity.delete_certificate(cloud, robot, certificate)
    # It may have reconnected before all servers knew of the revocation; without its policy it cannot again.
    identity.end_session(cloud, robot)
    iot, data = cloud.client("iot"), cloud.client("iot-data")
    # The next robot of this name must not inherit its settings. A robot that never connected has no shadow.
    with contextlib.suppress(data.exceptions.ResourceNotFoundException):
        data.delete_thing_shadow(thingName=robot, shadowName=SHADOW)
    identity.once_detached(iot, iot.delete_thing, thingName=robot)
    registry.forget(cloud, robot)


# Provisioning compares it, so it is no tag.
_SERIAL = "serial"
# What AWS IoT allows.
_TAG = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,128}")
_TAG_VALUE = re.compile(r"[A-Za-z0-9_.,@/:#=\[\]-]{1,800}")


def tags(cloud: Cloud) -> dict[str, dict[str, str]]:
    """Each robot's tags."""
    pages = (
        cloud.client("iot").get_paginator("list_things").paginate(thingTypeName=fleet_name(cloud.namespace))
    )
    return {
        str(thing["thingName"]): _tags(thing.get("attributes", {}))
        for page in pages
        for thing in page["things"]
    }


def change_tags(cloud: Cloud, robot: str, wanted: Mapping[str, str | None]) -> dict[str, str]:
    """Set tags, or remove those that are None; returns all tags of the robot.

    Raises `StationError` if the robot is not registered, `UsageError` for a tag that AWS IoT does not allow.
    """
    for name, value in wanted.items():
        if name == _SERIAL or not _TAG.fullmatch(name):
            raise UsageError(f"a tag's name must be letters, digits or _.,@/:#- and not serial, got {name}")
        if value is not None and not _TAG_VALUE.fullmatch(value):
            raise UsageError(f"a tag's value must be letters, digits or _.,@/:#=[]- , got {value!r}")
    iot = cloud.client("iot")
    try:
        known = iot.describe_thing(thingName=registry.checked(robot)).get("attributes", {})
        changed = {**known, **wanted}
        kept = {name: value for name, value in changed.items() if value is not None}
        if kept != known:
            iot.update_thing(thingName=robot, attributePayload={"attributes": kept, "merge": False})
    except iot.exceptions.ResourceNotFoundException as error:
        raise registry.not_registered(cloud, robot) from error
    return _tags(kept)


def _tags(attributes: Mapping[str, str]) -> dict[str, str]:
    return {name: value for name, value in sorted(attributes.items()) if name != _SERIAL}
