"""A viewer's lease on a robot's live lane: who looks, how often, and for how long.

A robot without a lease sends a live sample every `LIVE_BROKER_EVERY_S`. A viewer publishes its lease on the
robot's topic `VIEW`, `LEASE`, and again every `VIEW_RENEW_S` while it looks.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from iort_contract.checks import BOOT, check_version, checked, json_object, shown
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, SCHEMA_VERSION, ContractError
from iort_contract.messages.envelope import entries, read
from iort_contract.topics import VIEW, build_topic

# The longest lease: what a viewer costs that ends without a word.
VIEW_LEASE_MS = 15_000
# How often a viewer renews, so that two renewals may get lost.
VIEW_RENEW_S = 5.0
# Viewers of a robot with a lease of their own.
MAX_VIEWERS = 32
# The last level of the topic.
LEASE = "lease"


@dataclass(frozen=True)
class Lease:
    """One viewer's wish. ``viewer`` names it, at random. The robot sends each stream up to ``rate_hz`` times
    a second for ``lease_ms`` from the message's arrival; 0 ends the lease. With ``broker`` the viewer listens
    at the broker, so every message goes there; without, it listens at PubNub."""

    viewer: str
    rate_hz: float
    lease_ms: int
    broker: bool = False


def lease_topic(robot: str, namespace: str) -> str:
    """The topic of a robot's leases."""
    return build_topic(VIEW, robot, LEASE, namespace)


def encode_lease(lease: Lease) -> bytes:
    """The lease as JSON; raises `ContractError` if it is invalid."""
    _check(lease)
    return json.dumps({"v": SCHEMA_VERSION, **entries(lease)}, separators=(",", ":")).encode()


def decode_lease(payload: bytes | str) -> Lease:
    """Decode a lease; raises `ContractError` for everything that `encode_lease` cannot have written."""
    envelope = json_object(payload, "lease")
    check_version(envelope)
    lease = read(Lease, envelope)
    _check(lease)
    return lease


def _check(lease: Lease) -> None:
    checked(BOOT, lease.viewer, "viewer", "8 to 32 of 0-9 a-f")
    if not LIVE_MIN_RATE_HZ <= lease.rate_hz <= LIVE_MAX_RATE_HZ:
        raise ContractError(
            f"rate_hz must be {LIVE_MIN_RATE_HZ:g} to {LIVE_MAX_RATE_HZ:g}, got {shown(lease.rate_hz)}"
        )
    if type(lease.lease_ms) is not int or not 0 <= lease.lease_ms <= VIEW_LEASE_MS:
        raise ContractError(
            f"lease_ms must be an integer from 0 to {VIEW_LEASE_MS}, got {shown(lease.lease_ms)}"
        )
