"""What wakes, drives and stops robots, for the live page: leases, signed addresses, the emergency stop.

These share no connection with what is read, and the server has a lane for each.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import IOT, PUBNUB, VIEWER, client_prefix
from iort_contract.messages.live import VIEW_LEASE_MS, Lease
from iort_contract.messages.page import Identity, MotionAnswer, MotionEntry, SocketAnswer, ViewAnswer
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry, stopping, viewing
from iort_station.fleet.roles import Role, transport
from iort_station.operations.alarms import user
from iort_station.page.page import load_keys
from iort_station.page.requests import number, text, whole


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
    # Commands and looks at a camera go to the broker, whichever way the page listens.
    return {"live": live, "broker": _origin(cloud), **pubnub}


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


@functools.cache
def _role(cloud: Cloud, name: str) -> Role:
    return Role(prompt(cloud), name)


def address(cloud: Cloud, name: str) -> SocketAnswer:
    """A signed address of the broker for a viewer or a driver."""
    signed = _role(cloud, name).signed()
    return {"url": signed.url, "client_id": signed.client_id}


# Every open page asks for the fleet, and each robot costs a read of its shadow. For a while after a stop or a
# release somebody waits for the robots' word.
_KEPT_S, _KEPT_WAITING_S, _WAITING_S = 3.0, 0.1, 20.0


class Fleet:
    """The motion of every robot, read at most every few seconds however many pages ask; and its stop, which
    shares no connection and no lock with that."""

    def __init__(self, cloud: Cloud) -> None:
        self._cloud, self._urgent = prompt(cloud), cloud.urgent()
        self._lock = threading.Lock()
        self._read_s = self._changed_s = float("-inf")
        self._robots: dict[str, stopping.Motion] = {}

    def motion(self, request: Mapping[str, str]) -> MotionAnswer:
        """Of ``robot``, as it is now; without one, of the fleet."""
        robot = request.get("robot")
        return _motion(stopping.motion(self._cloud, [check_robot(robot)]) if robot else self._all(), {})

    def stop(self, request: Mapping[str, str]) -> MotionAnswer:
        """Stop ``robot``, or release it. Without one, stop the fleet, or release what that has stopped.
        ``seen_ms`` is the newest stop that the page shows: a release ends no stop after it."""
        stops = {"true": True, "false": False}.get(text(request, "stopped"))
        if stops is None:
            raise StationError("stopped must be true or false")
        chosen = [check_robot(request["robot"])] if request.get("robot") else None
        # As they were last read, if they ever were.
        known = list(self._robots)
        cloud, fleet = self._urgent, chosen is None
        if stops:
            # Nothing is looked up before it.
            failed = stopping.stop(cloud, chosen or known, by=user(), fleet=fleet)
            robots = chosen or self._names(known)
            failed |= stopping.stop(cloud, set(robots) - set(chosen or known), by=user(), fleet=fleet)
            unknown = set(chosen) - set(known) if chosen else set(known) - set(robots)
            failed |= stopping.take_back(cloud, unknown)
        else:
            robots = chosen or self._names(known)
            seen_ms = whole(request, "seen_ms", 0, 10**15)
            failed = stopping.release(cloud, robots, by=user(), fleet=fleet, seen_ms=seen_ms)
        # Read again when asked next, and often.
        self._changed_s = time.monotonic()
        return _motion(stopping.motion(cloud, [robot for robot in robots if robot not in failed]), failed)

    def _names(self, known: list[str]) -> list[str]:
        try:
            return list(registry.presence(self._urgent))
        except (BotoCoreError, ClientError):
            if not known:
                raise
            return known

    def _all(self) -> dict[str, stopping.Motion]:
        with self._lock:
            began_s = time.monotonic()
            kept_s = _KEPT_WAITING_S if began_s - self._changed_s < _WAITING_S else _KEPT_S
            # What was read while somebody changed it may be from before.
            if began_s - self._read_s >= kept_s or self._read_s <= self._changed_s:
                self._robots = stopping.motion(self._cloud, registry.presence(self._cloud))
                self._read_s = began_s
            return self._robots


@functools.cache
def fleet(cloud: Cloud) -> Fleet:
    """One for what asks and for what stops."""
    return Fleet(cloud)


def _motion(robots: Mapping[str, stopping.Motion], failed: dict[str, str]) -> MotionAnswer:
    entries = {robot: _entry(motion) for robot, motion in robots.items()}
    return {"robots": entries, "user": user(), "failed": failed}


def _entry(motion: stopping.Motion) -> MotionEntry:
    return {
        "asked": motion.asked,
        "stopped": motion.stopped,
        "reason": motion.reason,
        "stands": motion.stands,
        "stoppable": motion.stoppable,
        "why_not": motion.why_not,
        "alone": motion.alone,
        "by": motion.by.by if motion.by is not None else "",
        "at_ms": motion.by.t_ms if motion.by is not None else 0,
        "drive": None if motion.drive is None else {**asdict(motion.drive)},  # type: ignore[typeddict-item]  # its fields
        "video": None if motion.video is None else {**asdict(motion.video)},  # type: ignore[typeddict-item]  # its fields
    }


# The cards on a large screen, twice.
_MOST_ROBOTS = 256


def view(cloud: Cloud, request: Mapping[str, str]) -> ViewAnswer:
    """Publish a lease of ``viewer`` for each of ``robots``, separated by commas; ``lease_ms=0`` ends them.
    With ``broker`` the viewer listens there, and not at PubNub."""
    robots = text(request, "robots").split(",")
    if len(robots) > _MOST_ROBOTS:
        raise StationError(f"robots must be at most {_MOST_ROBOTS}, got {len(robots)}")
    lease = Lease(
        text(request, "viewer"),
        number(request, "rate_hz"),
        whole(request, "lease_ms", 0, VIEW_LEASE_MS),
        broker="broker" in request,
    )
    return {"asked": viewing.view(cloud, robots, lease)}
