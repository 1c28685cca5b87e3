"""The robots that may connect: thing, certificate, policy and the registry's row."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from iort_contract.cloud import fleet_name
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import certificates, registry
from iort_station.fleet.bundle import Bundle, configure, write_bundle
from iort_station.fleet.registry import listed

__all__ = ["F1TENTH", "Bundle", "add", "checked_vehicle", "configure", "listed", "remove"]

# The F1TENTH stack's vesc.yaml: erpm = gain * m/s + offset.
GAIN = "speed_to_erpm_gain"
F1TENTH = {GAIN: 4614.0, "speed_to_erpm_offset": 0.0}


# A gain or an offset of more, or a gain of less, is a slip of the hand.
_MOST, _LEAST = 1e9, 1e-9


def checked_vehicle(vehicle: Mapping[str, float]) -> dict[str, float]:
    """The vehicle parameters; raises `StationError` where one has another name or cannot be."""
    for name, value in vehicle.items():
        if name not in F1TENTH:
            raise StationError(f"{name} is no vehicle parameter; allowed are {', '.join(F1TENTH)}")
        # NaN is on no side of a bound.
        if not abs(value) <= _MOST or (name == GAIN and abs(value) < _LEAST):
            no_zero = " and not 0" if name == GAIN else ""
            raise StationError(
                f"{name} must be a number from {-_MOST:g} to {_MOST:g}{no_zero}, got {value:g}"
            )
    return dict(vehicle)


def add(
    cloud: Cloud,
    robot: str,
    *,
    out: Path,
    vehicle: Mapping[str, float] = F1TENTH,
    settings: Mapping[str, Any] | None = None,
) -> Bundle:
    """Register a robot and write its bundle into ``out/<robot>``, readable by the owner alone.

    ``vehicle`` are the parameters that Lambda 2 derives speed from; ``settings`` are more of the
    agent's settings for car.yaml (the source is a simulated car unless they say otherwise).

    Raises `StationError` for a name that is not allowed, a robot that is already there, and a
    deployment without the fleet stack.
    """
    registry.checked(robot)
    folder = out / robot
    if folder.exists() and any(folder.iterdir()):
        raise StationError(f"{folder} is not empty; its keys would be lost")
    # Before anything is registered: it will hold the only copy of the private key.
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    registry.enter(cloud, robot, vehicle)
    iot, fleet = cloud.client("iot"), fleet_name(cloud.namespace)
    try:
        iot.create_thing(
            thingName=robot, thingTypeName=fleet, attributePayload={"attributes": {"vehicle": "vesc"}}
        )
        iot.add_thing_to_thing_group(thingGroupName=fleet, thingName=robot)
        made = certificates.make(iot, robot)
        iot.attach_policy(policyName=fleet, target=made.arn)
        iot.attach_thing_principal(thingName=robot, principal=made.arn)
    except ClientError as error:
        raise StationError(
            f"robot {robot} is registered in part; remove it and try again: {error}"
        ) from error
    bundle = Bundle(robot, folder)
    write_bundle(cloud, bundle, made.pem, made.private_key_pem, settings or {})
    return bundle


def remove(cloud: Cloud, robot: str) -> None:
    """Take a robot away: its certificates are revoked, its session is cut, and then its certificates,
    its thing, its shadow and its row are deleted. What it has sent stays.

    Raises `StationError` for a robot that is not registered.
    """
    registry.get(cloud, robot)
    # No claim may give it a certificate meanwhile.
    registry.close_name(cloud, robot)
    held = certificates.attached(cloud, robot)
    for certificate in held:
        certificates.revoke(cloud, certificate)
    certificates.cut(cloud, robot)
    for certificate in held:
        certificates.delete(cloud, robot, certificate)
    # It may have come back before every server knew; without its policy it cannot do so again.
    certificates.cut(cloud, robot)
    iot, data = cloud.client("iot"), cloud.client("iot-data")
    # A robot that gets the name one day must not inherit what was wished of this one; there is none
    # where it never connected.
    with contextlib.suppress(data.exceptions.ResourceNotFoundException):
        data.delete_thing_shadow(thingName=robot, shadowName=SHADOW)
    certificates.once_detached(iot, iot.delete_thing, thingName=robot)
    registry.forget(cloud, robot)
