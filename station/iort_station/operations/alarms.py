"""The deployment's alarms with what they mean, who has seen them, and the cars that they may be about.

An acknowledgement is a tag of the alarm in CloudWatch: every operator's page and AWS' console show it, and it
needs no table. It names the time since when the alarm is raised, so it ends with that."""

from __future__ import annotations

import getpass
import re
import socket
import time
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

from iort_contract.catalog.alarms import Alarm
from iort_contract.catalog.metrics import alarm_of
from iort_contract.messages.page import Acknowledged, AlarmEntry, Rejected, RejectedAnswer
from iort_contract.tables import CONNECTED_MS, DISCONNECTED_MS, ONLINE, ROBOT
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.operations import quarantine

RAISED = "ALARM"
_TAG = "iort:acknowledged"
# What a tag's value may not have: "Tag", CloudWatch API.
_REFUSED = re.compile(r"[^\w .:/=+@-]", re.ASCII)
_MAX_NAME = 64
# The robots of an alarm, at most.
_MAX_ROBOTS = 12
# An alarm goes off minutes after its cause; an alert goes out at once, and again after 15 minutes.
_BEFORE_S = 1200
_MAX_REJECTED = 20
_ORDER = (RAISED, "INSUFFICIENT_DATA", "OK")


def alarms(cloud: Cloud) -> list[AlarmEntry]:
    """Every alarm of the deployment: the raised ones first, and of these the newest first."""
    found = list(_deployed(cloud))
    raised = any(alarm["StateValue"] == RAISED and entry.evidence == "cars" for alarm, entry in found)
    rows = list(registry.listed(cloud)) if raised else []
    entries = [_entry(cloud, alarm, entry, rows) for alarm, entry in found]
    return sorted(entries, key=lambda alarm: (_ORDER.index(alarm["state"]), -alarm["since_s"]))


def acknowledge(cloud: Cloud, key: str, since_s: float, by: str = "") -> Acknowledged:
    """Note on an alarm that ``by`` has seen it; ``since_s`` is the time since when it is raised.

    Raises `StationError` for an unknown alarm, and if its state has changed meanwhile.
    """
    names = f"{cloud.namespace}-{key}"
    answer = cloud.client("cloudwatch").describe_alarms(AlarmNames=[names], AlarmTypes=["MetricAlarm"])
    # The names of another deployment, such as iort-2, may begin like ours.
    if not answer["MetricAlarms"] or not key.isalnum():
        raise StationError(f"alarm {key[:80]!r} does not exist; `iort alarms --all` lists them")
    (alarm,) = answer["MetricAlarms"]
    if alarm["StateValue"] != RAISED or _since_ms(alarm) != round(since_s * 1000):
        raise StationError(f"alarm {key} has changed meanwhile: look at it again")
    seen: Acknowledged = {"by": _REFUSED.sub("_", by.strip())[:_MAX_NAME] or user(), "at_s": time.time()}
    value = f"{_since_ms(alarm)} {round(seen['at_s'] * 1000)} {seen['by']}"
    tag = {"Key": _TAG, "Value": value}
    cloud.client("cloudwatch").tag_resource(ResourceARN=alarm["AlarmArn"], Tags=[tag])
    return seen


def user() -> str:
    """The user of this machine, as user@host."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        name = "somebody"
    return _REFUSED.sub("_", f"{name}@{socket.gethostname()}")[:_MAX_NAME]


def rejected(cloud: Cloud) -> RejectedAnswer:
    """The newest messages in quarantine."""
    found = sorted(quarantine.entries(cloud), key=lambda letter: (-letter.last_ms, letter.id))
    told: list[Rejected] = [
        {
            "id": letter.id,
            "robot": letter.robot,
            "source": letter.source,
            "topic": letter.topic,
            "reason": letter.reason,
            "last_s": letter.last_ms / 1000,
            "seen": letter.seen,
        }
        for letter in found[:_MAX_REJECTED]
    ]
    return {"rejected": told, "found": len(found)}


def _deployed(cloud: Cloud) -> Iterable[tuple[Mapping[str, Any], Alarm]]:
    prefix = f"{cloud.namespace}-"
    pages = cloud.client("cloudwatch").get_paginator("describe_alarms")
    for page in pages.paginate(AlarmNamePrefix=prefix, AlarmTypes=["MetricAlarm"]):
        for alarm in page["MetricAlarms"]:
            key = alarm["AlarmName"].removeprefix(prefix)
            entry = alarm_of(key)
            # The names of another deployment, such as iort-2, may begin like ours.
            if entry is not None and key.isalnum():
                yield alarm, entry


def _entry(
    cloud: Cloud, alarm: Mapping[str, Any], entry: Alarm, rows: Iterable[Mapping[str, Any]]
) -> AlarmEntry:
    raised, since_s = alarm["StateValue"] == RAISED, _since_ms(alarm) / 1000
    robots, named = _robots(rows, entry, since_s) if raised and entry.evidence == "cars" else ([], False)
    return {
        "name": alarm["AlarmName"],
        "key": alarm["AlarmName"].removeprefix(f"{cloud.namespace}-"),
        "about": alarm.get("AlarmDescription", ""),
        "state": alarm["StateValue"],
        "reason": alarm.get("StateReason", ""),
        "since_s": since_s,
        "meaning": entry.meaning,
        "advice": entry.advice,
        "evidence": entry.evidence,
        "threshold": alarm.get("Threshold"),
        "robots": robots,
        "named": named,
        "acknowledged": _acknowledged(cloud, alarm) if raised else None,
    }


def _since_ms(alarm: Mapping[str, Any]) -> int:
    """The time of the last change of state; the time of the last update is the same or later."""
    at: datetime = alarm.get("StateTransitionedTimestamp") or alarm["StateUpdatedTimestamp"]
    return round(at.timestamp() * 1000)


def _acknowledged(cloud: Cloud, alarm: Mapping[str, Any]) -> Acknowledged | None:
    tags = cloud.client("cloudwatch").list_tags_for_resource(ResourceARN=alarm["AlarmArn"])["Tags"]
    value = next((tag["Value"] for tag in tags if tag["Key"] == _TAG), "")
    since_ms, _, rest = value.partition(" ")
    at_ms, _, by = rest.partition(" ")
    # An alarm that ended and came back is new again.
    if since_ms != str(_since_ms(alarm)) or not at_ms.isdecimal():
        return None
    return {"by": by, "at_s": int(at_ms) / 1000}


def _robots(rows: Iterable[Mapping[str, Any]], entry: Alarm, since_s: float) -> tuple[list[str], bool]:
    """The cars that an alert has named around this time; without such, those that were connected."""
    rows = list(rows)
    named = [
        row
        for row in rows
        if entry.alert
        and any(name.startswith(entry.alert) and at >= since_s - _BEFORE_S for name, at in row.items())
    ]
    chosen = named or [row for row in rows if _was_connected(row, since_s)]
    return sorted(str(row[ROBOT]) for row in chosen)[:_MAX_ROBOTS], bool(named)


def _was_connected(row: Mapping[str, Any], since_s: float) -> bool:
    if row.get(ONLINE):
        return int(row.get(CONNECTED_MS, 0)) <= since_s * 1000
    return int(row.get(DISCONNECTED_MS, 0)) >= (since_s - _BEFORE_S) * 1000
