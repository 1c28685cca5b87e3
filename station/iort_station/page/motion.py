"""What wakes, drives and stops robots, for the live page: leases, signed addresses, the emergency stop.

These share no connection with what is read, and the server has a lane for each.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import DRIVER, IOT, PUBNUB, VIEWER, client_prefix
from iort_contract.messages.page import Answer, Identity, MotionAnswer, MotionEntry, SocketAnswer, ViewAnswer
from iort_contract.messages.viewing import VIEW_LEASE_MS, Lease
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry, stopping, viewing
from iort_station.fleet.roles import Role, has_drivers, transport
from iort_station.operations.monitoring.alarms import user
from iort_station.page.page import DRIVE, load_keys
from iort_station.page.requests import number, text, whole
from iort_station.page.server import Handler


def socket_answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], SocketAnswer]]:
    """The answer ``socket``: a viewer's address."""
    return {"socket": _addresses(cloud, VIEWER)}


def socket_actions(cloud: Cloud) -> dict[str, Handler]:
    """The action ``drive``: a driver's address, if the deployment has drivers."""
    return {DRIVE: _addresses(cloud, DRIVER)} if has_drivers(cloud) else {}


def reaching(cloud: Cloud, live: str) -> dict[str, Any]:
    """Keyword arguments for a page's server: the way ``live`` of live messages, and the broker's address.

    Raises `StationError` if that way cannot be used.
    """
    if live == PUBNUB and transport(cloud) == IOT:
        raise StationError(
            "this deployment sends nothing to PubNub (live_transport=iot): leave --live away, or deploy with "
            "-c live_transport=pubnub"
        )
    pubnub = load_keys(cloud).reading() if live == PUBNUB else {}
    # A driver's commands go to the broker, whichever way the page listens.
    broker = {"broker": _origin(cloud)} if live == IOT or has_drivers(cloud) else {}
    return {"live": live, **broker, **pubnub}


def everybody(cloud: Cloud) -> dict[str, Any]:
    """Keyword arguments for the configuration of a page without a server, which anybody can read."""
    vehicles = registry.vehicles(cloud)
    if transport(cloud) == PUBNUB:
        return {"vehicles": vehicles, **load_keys(cloud).reading()}
    everybodys = identity(cloud)
    shown = everybodys["robots"] or vehicles
    return {
        "vehicles": {robot: car for robot, car in vehicles.items() if robot in shown},
        "live": IOT,
        "identity": everybodys,
    }


def identity(cloud: Cloud) -> Identity:
    """The identity that everybody gets; raises `StationError` if the deployment has none."""
    robots = cloud.output("fleet", "PublicRobots")
    endpoint = cloud.client("cognito-identity").meta.endpoint_url
    if cloud.websocket:
        endpoint = f"http://{urlsplit(cloud.websocket).netloc}"
    return {
        "pool": cloud.output("fleet", "PublicPoolId"),
        "region": cloud.region_name or "",
        "endpoint": endpoint,
        "socket": cloud.websocket_url,
        "client_prefix": client_prefix(VIEWER, cloud.namespace),
        "robots": [] if robots == "*" else robots.split(","),
    }


@functools.cache
def prompt(cloud: Cloud) -> Cloud:
    """The cloud of addresses, leases and motion: their clients wait for no other reading, and a stop has its
    own."""
    return cloud.urgent()


def _origin(cloud: Cloud) -> str:
    address = urlsplit(cloud.websocket_url)
    return f"{address.scheme}://{address.netloc}"


def _addresses(cloud: Cloud, name: str) -> Callable[[Mapping[str, str]], SocketAnswer]:
    role = Role(prompt(cloud), name)

    def answer(_asked: Mapping[str, str]) -> SocketAnswer:
        signed = role.signed()
        return {"url": signed.url, "client_id": signed.client_id}

    return answer


# Every open page asks for the fleet, and each robot costs a read of its shadow. For a while after a stop or a
# release somebody waits for the robots' word.
_KEPT_S, _KEPT_WAITING_S, _WAITING_S = 3.0, 0.1, 20.0


class _Fleet:
    """The motion of every robot, read at most every few seconds however many pages ask."""

    def __init__(self, cloud: Cloud) -> None:
        self.cloud = prompt(cloud)
        self._lock = threading.Lock()
        self._read_s = self._changed_s = float("-inf")
        self._found: dict[str, stopping.Motion] = {}

    def motion(self) -> dict[str, stopping.Motion]:
        with self._lock:
            began_s = time.monotonic()
            kept_s = _KEPT_WAITING_S if began_s - self._changed_s < _WAITING_S else _KEPT_S
            # What was read while somebody changed it may be from before.
            if began_s - self._read_s >= kept_s or self._read_s <= self._changed_s:
                self._found = stopping.motion(self.cloud, registry.presence(self.cloud))
                self._read_s = began_s
            return self._found

    def names(self) -> list[str]:
        """The robots as they were last read, if they ever were."""
        return list(self._found)

    def changed(self) -> None:
        """A stop or a release was asked for: read again when asked next, and often. Waits for no reading."""
        self._changed_s = time.monotonic()


@functools.cache
def _fleet(cloud: Cloud) -> _Fleet:
    """One for what asks and for what stops."""
    return _Fleet(cloud)


def motion_answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """The answer ``motion``: of ``robot``, as it is now; without one, of the fleet."""
    fleet = _fleet(cloud)

    def listed(asked: Mapping[str, str]) -> MotionAnswer:
        robot = asked.get("robot")
        return _told(stopping.motion(fleet.cloud, [check_robot(robot)]) if robot else fleet.motion(), {})

    return {"motion": listed}


def motion_actions(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], Answer]]:
    """The action ``stop``. It shares no connection with what is read."""
    fleet, urgent = _fleet(cloud), cloud.urgent()

    def everyone(known: list[str]) -> list[str]:
        try:
            return list(registry.presence(urgent))
        except (BotoCoreError, ClientError):
            if not known:
                raise
            return known

    def stop(asked: Mapping[str, str]) -> MotionAnswer:
        """Stop ``robot``, or release it. Without one, stop the fleet, or release what that has stopped.
        ``seen_ms`` is the newest stop that the page shows: a release ends no stop after it."""
        wanted = {"true": True, "false": False}.get(text(asked, "stopped"))
        if wanted is None:
            raise StationError("stopped must be true or false")
        one = [check_robot(asked["robot"])] if asked.get("robot") else None
        known = fleet.names()
        if wanted:
            # Nothing is looked up before it.
            failed = stopping.stop(urgent, one or known, by=user(), fleet=one is None)
            robots = one or everyone(known)
            failed |= stopping.stop(urgent, set(robots) - set(one or known), by=user(), fleet=one is None)
            failed |= stopping.take_back(urgent, set(one) - set(known) if one else set(known) - set(robots))
        else:
            robots = one or everyone(known)
            seen_ms = whole(asked, "seen_ms", 0, 10**15)
            failed = stopping.release(urgent, robots, by=user(), fleet=one is None, seen_ms=seen_ms)
        fleet.changed()
        return _told(stopping.motion(urgent, [robot for robot in robots if robot not in failed]), failed)

    return {"stop": stop}


def _told(found: Mapping[str, stopping.Motion], failed: dict[str, str]) -> MotionAnswer:
    return {"robots": {robot: _entry(one) for robot, one in found.items()}, "user": user(), "failed": failed}


def _entry(one: stopping.Motion) -> MotionEntry:
    return {
        "asked": one.asked,
        "stopped": one.stopped,
        "reason": one.reason,
        "stands": one.stands,
        "stoppable": one.stoppable,
        "why_not": one.why_not,
        "alone": one.alone,
        "by": one.by.by if one.by is not None else "",
        "at_ms": one.by.t_ms if one.by is not None else 0,
        "drive": None if one.drive is None else {**asdict(one.drive)},  # type: ignore[typeddict-item]  # its fields
    }


# The cards on a large screen, twice.
_MOST_ROBOTS = 256


def view(cloud: Cloud, asked: Mapping[str, str]) -> ViewAnswer:
    """Publish a lease of ``viewer`` for each of ``robots``, separated by commas; ``lease_ms=0`` ends them.
    With ``broker`` the viewer listens there, and not at PubNub."""
    robots = text(asked, "robots").split(",")
    if len(robots) > _MOST_ROBOTS:
        raise StationError(f"robots must be at most {_MOST_ROBOTS}, got {len(robots)}")
    lease = Lease(
        text(asked, "viewer"),
        number(asked, "rate_hz"),
        whole(asked, "lease_ms", 0, VIEW_LEASE_MS),
        broker="broker" in asked,
    )
    return {"asked": viewing.view(cloud, robots, lease)}
