"""How the page reaches the broker: addresses signed for a viewer or a driver, and everybody's identity."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from iort_contract.cloud import DRIVER, IOT, PUBNUB, VIEWER, client_prefix
from iort_contract.messages.page import Identity, SocketAnswer
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.roles import Role, has_drivers, transport
from iort_station.page import keys
from iort_station.page.page import DRIVE
from iort_station.page.server import Answer


def answers(cloud: Cloud) -> dict[str, Callable[[Mapping[str, str]], SocketAnswer]]:
    """The answer ``socket``: a viewer's address."""
    return {"socket": _addresses(cloud, VIEWER)}


def actions(cloud: Cloud) -> dict[str, Answer]:
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
    pubnub = keys.load(cloud).reading() if live == PUBNUB else {}
    # A driver's commands go to the broker, whichever way the page listens.
    broker = {"broker": _origin(cloud)} if live == IOT or has_drivers(cloud) else {}
    return {"live": live, **broker, **pubnub}


def everybody(cloud: Cloud) -> dict[str, Any]:
    """Keyword arguments for the configuration of a page without a server, which anybody can read."""
    vehicles = registry.vehicles(cloud)
    if transport(cloud) == PUBNUB:
        return {"vehicles": vehicles, **keys.load(cloud).reading()}
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
