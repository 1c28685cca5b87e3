"""A robot's tags: the attributes of its thing, such as its laboratory or its team."""

from __future__ import annotations

import re
from collections.abc import Mapping

from iort_contract.cloud import fleet_name
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet import registry

# Provisioning compares it, so it is no tag.
_SERIAL = "serial"
# What AWS IoT allows.
_NAME = re.compile(r"[A-Za-z0-9_.,@/:#-]{1,128}")
_VALUE = re.compile(r"[A-Za-z0-9_.,@/:#=\[\]-]{1,800}")


def listed(cloud: Cloud) -> dict[str, dict[str, str]]:
    """Each robot's tags."""
    pages = (
        cloud.client("iot").get_paginator("list_things").paginate(thingTypeName=fleet_name(cloud.namespace))
    )
    return {
        str(thing["thingName"]): _tags(thing.get("attributes", {}))
        for page in pages
        for thing in page["things"]
    }


def change(cloud: Cloud, robot: str, wanted: Mapping[str, str | None]) -> dict[str, str]:
    """Set tags, or remove those that are None; returns all tags of the robot.

    Raises `StationError` if the robot is not registered, `UsageError` for a tag that AWS IoT does not allow.
    """
    for name, value in wanted.items():
        if name == _SERIAL or not _NAME.fullmatch(name):
            raise UsageError(f"a tag's name must be letters, digits or _.,@/:#- and not serial, got {name}")
        if value is not None and not _VALUE.fullmatch(value):
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
