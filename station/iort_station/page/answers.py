"""Every answer, action and download of the live page's server, by its name.

Each is a function of the request's parameters; its type is in `iort_contract.messages.page`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Mapping
from functools import partial
from typing import Any

from iort_contract.cloud import DRIVER, VIEWER
from iort_contract.messages.commands import MAX_LEASE_MS
from iort_contract.messages.page import (
    Answer,
    IceAnswer,
    SendAnswer,
    SettingEntry,
    SettingKind,
    SettingsAnswer,
)
from iort_contract.messages.shadow import FIELDS, MOTION_STOPPED, SETTINGS, Choice, Flag, Number
from iort_contract.tables import ONLINE
from iort_contract.topics import ACCEPTED
from iort_contract.track import Track
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.errors import StationError
from iort_station.fleet import control, registry, robots
from iort_station.fleet.control import Shadow, State
from iort_station.fleet.relays import Relays
from iort_station.fleet.roles import has_drivers
from iort_station.operations import alarms, cloudwatch
from iort_station.page import history, incidents, insights, motion, triggers
from iort_station.page.page import DRIVE
from iort_station.page.requests import Handler, robot_of, text, whole
from iort_station.page.server import Download

# A viewer waits for a robot's answer.
_ANSWER_S = 10.0


def answers(cloud: Cloud, track: Track | None = None) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """Every answer, by its name; ``track`` is the page's."""

    def minutes(request: Mapping[str, str]) -> int:
        return whole(request, "minutes", 1, 14 * 24 * 60)

    counts, pictures = incidents.Counts(cloud), incidents.Pictures(cloud)
    relays = Relays(cloud)
    return {
        "robots": lambda _request: {"robots": registry.presence(cloud)},
        "tags": lambda _request: {"tags": robots.tags(cloud)},
        "vehicles": lambda _request: {"vehicles": registry.vehicles(cloud)},
        "streams": lambda request: {"streams": inventory.streams_of(cloud, robot_of(request))},
        "fields": lambda request: history.fields(cloud, request),
        "runs": lambda request: history.runs_of(cloud, request),
        "history": lambda request: history.history(cloud, request),
        "dashboards": lambda _request: {"dashboards": cloudwatch.dashboards(cloud)},
        "dashboard": lambda request: cloudwatch.dashboard(
            cloud, text(request, "name"), minutes=minutes(request)
        ),
        "log": lambda request: cloudwatch.rows(
            cloud, text(request, "name"), whole(request, "widget", 0, 500), minutes=minutes(request)
        ),
        "alarms": lambda _request: {"alarms": alarms.alarms(cloud), "user": alarms.user()},
        "rejected": lambda _request: alarms.rejected(cloud),
        "insights": lambda request: insights.insights(cloud, request),
        "analysis": lambda request: insights.progress(cloud, request),
        "laps": lambda request: insights.laps(cloud, request),
        "delta": lambda request: insights.delta(cloud, request),
        "raceline": lambda _request: insights.raceline(track),
        "triggers": lambda request: triggers.triggers(cloud, request),
        "dry_run": lambda request: triggers.count(cloud, request),
        "notes": lambda request: insights.notes(cloud, request),
        "incidents": lambda request: incidents.incidents(cloud, request),
        "incident_counts": lambda _request: counts.answer(),
        "incident_picture": pictures.answer,
        "motion": motion.fleet(cloud).motion,
        "socket": lambda _request: motion.address(cloud, VIEWER),
        "ice": lambda _request: ice(relays),
    }


def actions(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Mapping[str, Any]]]:
    """What everybody who reaches the page may do, by its name."""
    return {
        "view": lambda request: motion.view(motion.prompt(cloud), request),
        "acknowledge": lambda request: alarms.acknowledge(
            cloud, text(request, "alarm"), whole(request, "since_ms", 0, 2**53) / 1000, request.get("by", "")
        ),
    }


def keyed_actions(cloud: Cloud) -> dict[str, Handler]:
    """What moves or changes a robot, or costs something, by its name; only for a server on loopback."""
    return {
        "send": lambda request: send(cloud, request),
        "settings": lambda request: settings(cloud, request),
        "set": lambda request: change(cloud, request),
        "analyse": lambda request: insights.analyse(cloud, request),
        "note": lambda request: insights.write_note(cloud, request),
        "delete_note": lambda request: insights.remove_note(cloud, request),
        "keep": lambda request: incidents.keep(cloud, request),
        "add_trigger": lambda request: triggers.add(cloud, request),
        "remove_trigger": lambda request: triggers.remove(cloud, request),
        "stop": motion.fleet(cloud).stop,
        **({DRIVE: lambda _request: motion.address(cloud, DRIVER)} if has_drivers(cloud) else {}),
    }


def downloads(cloud: Cloud) -> dict[str, Download]:
    """Every file, by its name."""
    return {**history.downloads(cloud), "incident.mcap": partial(incidents.download, cloud)}


def ice(relays: Relays) -> IceAnswer:
    """The deployment's servers for WebRTC."""
    return {
        "ice_servers": [
            {"urls": list(one.urls), "username": one.username, "credential": one.credential}
            for one in relays.servers()
        ]
    }


def send(cloud: Cloud, request: Mapping[str, str]) -> Generator[None, None, SendAnswer]:
    """Send the ``command`` of this name with its ``message`` to ``robot``, for ``lease_ms`` if it moves;
    ``takeover`` takes the wheel from whoever drives, ``blind`` moves one with video without its picture. It
    yields while it waits for the robot."""
    try:
        message = json.loads(text(request, "message"))
    except (ValueError, RecursionError) as error:
        raise StationError(f"the message must be JSON: {error}") from error
    if not isinstance(message, dict):
        raise StationError("the message must be a JSON object with the fields of the ROS message")
    lease_ms = whole(request, "lease_ms", 1, MAX_LEASE_MS) if request.get("lease_ms") else None
    began = time.monotonic()
    robot, name = text(request, "robot"), text(request, "command")
    takeover, blind = (request.get(word) == "true" for word in ("takeover", "blind"))
    sent = yield from control.sending(
        cloud, robot, name, message, lease_ms=lease_ms, takeover=takeover, blind=blind
    )
    after_ms = round((time.monotonic() - began) * 1000)
    if sent.outcome is None:
        return {"accepted": None, "reason": sent.offline, "after_ms": after_ms}
    accepted = sent.outcome == ACCEPTED
    return {"accepted": accepted, "reason": "" if accepted else sent.outcome, "after_ms": after_ms}


def settings(cloud: Cloud, request: Mapping[str, str]) -> SettingsAnswer:
    """The settings of ``robot``: those in force, and what is pending."""
    robot = text(request, "robot")
    state = Shadow(cloud, robot).read()
    return {"settings": _entries(state, {}), "online": bool(registry.get(cloud, robot).get(ONLINE))}


def change(cloud: Cloud, request: Mapping[str, str]) -> SettingsAnswer:
    """Change the setting ``name`` of ``robot`` to ``value``; without a value, car.yaml's applies again."""
    robot, name = text(request, "robot"), text(request, "name")
    if name == MOTION_STOPPED:
        raise StationError("the emergency stop has a button of its own")
    value = control.parse_setting(name, request["value"]) if "value" in request else None
    changed = control.change_settings(cloud, robot, {name: value}, _ANSWER_S)
    reasons = {rejected: change.reason for rejected, change in changed.rejected.items()}
    return {"settings": _entries(changed.state, reasons), "online": changed.online}


def _entries(state: State, reasons: Mapping[str, str]) -> list[SettingEntry]:
    in_force, desired, pending = state.reported.settings, state.desired.settings, state.pending()
    selections = sorted(name for name in {*in_force, *desired} if name.startswith(f"{FIELDS}."))
    rejected = {name: change.reason for name, change in state.rejected().items()}
    return [
        {
            **_kind(SETTINGS.get(name)),
            "name": name,
            "value": _written(in_force.get(name)),
            # A rejected change is withdrawn.
            "desired": name in desired and name not in reasons,
            "pending": _written(pending[name]) if name in pending else None,
            "reason": reasons.get(name) or rejected.get(name, ""),
        }
        for name in (*SETTINGS, *selections)
        # It has a button of its own, which asks before it releases and tells who did.
        if name != MOTION_STOPPED
    ]


def _kind(setting: Flag | Number | Choice | None) -> SettingKind:
    """The part of an entry that the contract knows; None is a selection of fields."""
    plain: SettingKind = {"kind": "fields", "low": 0.0, "high": 0.0, "unit": "", "names": []}
    if isinstance(setting, Number):
        return {**plain, "kind": "number", "low": setting.low, "high": setting.high, "unit": setting.unit}
    if isinstance(setting, Choice):
        return {**plain, "kind": "choice", "names": list(setting.names)}
    return {**plain, "kind": "flag"} if isinstance(setting, Flag) else plain


def _written(value: Any) -> str:
    return "" if value is None else control.setting_text(value)
