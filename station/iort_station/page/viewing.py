"""The page's leases on robots' live lanes, as its server publishes them."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

from iort_contract.messages.page import ViewAnswer
from iort_contract.messages.viewing import VIEW_LEASE_MS, Lease, encode_lease, lease_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.page.parameters import number, text, whole

# The cards on a large screen, twice.
_MOST_ROBOTS = 256
_AT_ONCE = 8


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
    payload, data = encode_lease(lease), cloud.client("iot-data")
    topics = [lease_topic(robot, cloud.namespace) for robot in robots]
    with ThreadPoolExecutor(min(_AT_ONCE, len(topics))) as pool:
        list(pool.map(lambda topic: data.publish(topic=topic, qos=0, payload=payload), topics))
    return {"asked": len(topics)}
