"""Copies what is known of a robot into another deployment: row, thing with its tags, desired settings,
quarantined messages, findings and notes; and gives it a new certificate.

Until the robot has connected to the target, the source's values replace the target's. Then the target's stay.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

import yaml

from iort_contract import tables
from iort_contract.dynamodb import Item
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.errors import StationError
from iort_station.fleet import identity, registry, robots
from iort_station.fleet.identity import Bundle
from iort_station.migration.plan import origin

# What a registry's row says of the deployment and not of the robot.
_STAYS = frozenset({tables.ROBOT, tables.MOVED_FROM, *tables.DAYS, *tables.PRESENCE, *tables.ADMISSION}) - {
    tables.SERIAL
}
_COUNTERS = (tables.ALERT_PREFIX, tables.ASKED_PREFIX)


def copy(source: Cloud, target: Cloud, robot: str) -> bool:
    """Register a robot in the target, or bring its registration there up to date; returns whether it was new.

    A robot that the source has removed stays removed.
    """
    row, there = registry.find(source, robot), registry.find(target, robot)
    if row is None:
        return False
    carried = _carried(row)
    if there is None:
        registry.enter(target, robot, {**carried, tables.MOVED_FROM: origin(source)})
    elif tables.MOVED_FROM not in there:
        registry.set_moved(target, robot, origin(source))
    if there is None or tables.CONNECTED_MS not in there:
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
    return {**kept, **({tables.STREAMS: set(kept[tables.STREAMS])} if tables.STREAMS in kept else {})}


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
    desired.pop(tables.OVER_SHARE, None)
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
    if row is None or tables.ADMITTED_CERTIFICATE in row or tables.CONNECTED_MS in row:
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


# Moves a robot's quarantined messages, byte for byte.


def copy_quarantine(source: Cloud, target: Cloud, robot: str) -> int:
    """Copy the messages that the target lacks; returns how many."""
    wanted = lacking(source, target, robot)
    client, table = target.client("dynamodb"), target.output("storage", "QuarantineTable")
    for item in _items(source, robot) if wanted else ():
        if item[tables.ENTRY]["S"] in wanted:
            client.put_item(TableName=table, Item=item)
    return len(wanted)


def lacking(source: Cloud, target: Cloud, robot: str) -> set[str]:
    """The ids of the source's messages that the target does not have."""
    names = {
        "#robot": tables.ROBOT,
        "#id": tables.ENTRY,
        "#expires": tables.EXPIRES_S,
        "#last": tables.LAST_MS,
    }
    keys = {"ProjectionExpression": "#id, #expires, #last", "ExpressionAttributeNames": names}
    # Of a message that was replayed the id is left.
    there = {item[tables.ENTRY]["S"] for item in _items(target, robot, **keys)}
    now_s = time.time()
    return {
        str(item[tables.ENTRY]["S"])
        for item in _items(source, robot, **keys)
        if tables.LAST_MS in item
        and item[tables.ENTRY]["S"] not in there
        # DynamoDB is about to delete those that have expired.
        and (tables.EXPIRES_S not in item or int(item[tables.EXPIRES_S]["N"]) > now_s)
    }


def _items(cloud: Cloud, robot: str, **request: Any) -> Iterator[Item]:
    asked = {
        "TableName": cloud.output("storage", "QuarantineTable"),
        "ConsistentRead": True,
        "KeyConditionExpression": "#robot = :robot",
        "ExpressionAttributeNames": {"#robot": tables.ROBOT},
        "ExpressionAttributeValues": {":robot": {"S": robot}},
        **request,
    }
    for page in cloud.client("dynamodb").get_paginator("query").paginate(**asked):
        yield from page["Items"]


# Moves what the analysis and people have written about robots: findings, analysed drives and notes.


def copy_findings(source: Cloud, target: Cloud, robot: str) -> int:
    """Copy the findings, analysed drives and notes of a robot that the target lacks; returns how many.

    A note that was deleted on either side is deleted in the target.
    """
    old, new = findings.findings_table(source), findings.findings_table(target)
    # The target may have analysed a drive again, with all of its batches.
    analysed, there = {one.drive for one in new.drives(robot)}, {note.id for note in new.notes(robot)}
    # A drive whose analysis failed has a finding, and no row.
    found = {finding.id for finding in new.findings(robot)}
    count = 0
    for finding in old.findings(robot):
        if finding.drive not in analysed and finding.id not in found:
            new.put_finding(finding)
            count += 1
    # After its findings: a move that ends between them goes on.
    for drive in old.drives(robot):
        if drive.drive not in analysed:
            new.put_drive(drive)
            count += 1
    removed = old.removed_notes(robot)
    for note_id in removed & there:
        new.remove_note(robot, note_id)
    removed |= new.removed_notes(robot)
    for note in old.notes(robot):
        if note.id not in there | removed:
            new.put_note(note)
            count += 1
    return count
