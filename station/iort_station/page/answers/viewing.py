"""The page's leases on robots' live lanes, as its server publishes them."""

from __future__ import annotations

from collections.abc import Mapping

from iort_contract.messages.page import ViewAnswer
from iort_contract.messages.viewing import VIEW_LEASE_MS, Lease
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import viewing
from iort_station.page.answers.parameters import number, text, whole

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
