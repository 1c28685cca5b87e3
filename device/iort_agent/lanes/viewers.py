"""Who looks at the live lane, and what it therefore sends.

A viewer's lease counts from its arrival, by the monotonic clock. Without one, the lane sends a message of
each stream every ten seconds; with one, up to the highest rate that a viewer asks for. `live.when: always`
sends at the full rate all the time, and so does a robot that may not hear its viewers: its policy is older
than the agent.
"""

from __future__ import annotations

import logging
import threading
from typing import NamedTuple

from iort_agent.common.logs import ThrottledLog
from iort_agent.lanes import RuntimeSettings
from iort_agent.lanes.live import Demand, LiveLane
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.limits import LIVE_BROKER_EVERY_S, ContractError
from iort_contract.messages.live import MAX_VIEWERS, decode_lease, lease_topic
from iort_contract.messages.shadow import ALWAYS

_log = logging.getLogger(__name__)

# A robot that is connected and still not subscribed after this time will not be.
_DEAF_S = 5.0
# The name of the lease that all viewers beyond `MAX_VIEWERS` share. No viewer has it.
_CROWD = "crowd"


class _Look(NamedTuple):
    """A viewer's lease, until a monotonic time."""

    until: float
    demand: Demand


def _both(one: _Look, other: _Look) -> _Look:
    rate_hz = max(one.demand.rate_hz, other.demand.rate_hz)
    to_broker = one.demand.to_broker or other.demand.to_broker
    return _Look(max(one.until, other.until), Demand(rate_hz, to_broker))


class Viewers:
    """Keeps the leases, and tells the lane what they ask for. With ``to_broker`` the lane that sends always
    sends everything to the broker. Safe to use from several threads."""

    def __init__(self, link: Link, lane: LiveLane, settings: RuntimeSettings, *, to_broker: bool) -> None:
        self._clock, self._uplink, self._lane = link.clock, link.uplink, lane
        self._settings, self._to_broker = settings, to_broker
        self._rejections = ThrottledLog(_log, link.clock)
        self._lock = threading.Lock()
        self._looks: dict[str, _Look] = {}
        self._topic = lease_topic(link.robot, link.namespace)
        # When it last heard its viewers, or could hear nobody.
        self._heard = self._clock.monotonic()
        self._hears = True
        self._told = self._demand()
        lane.follow(self._told)
        self._uplink.subscribe(self._topic, self._on_lease)

    def count(self) -> int:
        """How many viewers look now."""
        return len(self._looks)

    def apply(self, settings: RuntimeSettings) -> None:
        """Use other settings from now on."""
        with self._lock:
            self._settings = settings
            self._tell()

    def tick(self) -> None:
        """End the leases that are over; called several times a second."""
        now = self._clock.monotonic()
        with self._lock:
            for viewer in [viewer for viewer, look in self._looks.items() if now >= look.until]:
                del self._looks[viewer]
            if self._uplink.subscribed(self._topic) or not self._uplink.connected():
                self._heard = now
            self._hears = now - self._heard < _DEAF_S
            self._tell()

    def _on_lease(self, message: MqttMessage) -> None:
        try:
            lease = decode_lease(message.payload)
        except ContractError as error:
            self._rejections.warn("malformed", f"live: a viewer's lease is rejected: {error}")
            return
        look = _Look(message.at + lease.lease_ms / 1000, Demand(lease.rate_hz, lease.broker))
        with self._lock:
            full = lease.viewer not in self._looks and len(self._looks.keys() - {_CROWD}) >= MAX_VIEWERS
            viewer = _CROWD if full else lease.viewer
            begins = viewer not in self._looks
            if look.until > self._clock.monotonic():
                self._looks[viewer] = look if begins or not full else _both(self._looks[viewer], look)
            else:
                begins = False
                # A viewer of the crowd that ends does not end the others'.
                self._looks.pop(lease.viewer, None)
            self._tell(at_once=begins)

    def _demand(self) -> Demand:
        most_hz = self._settings.live_rate_hz
        demands = [look.demand for look in self._looks.values()]
        to_broker = any(demand.to_broker for demand in demands)
        if self._settings.live_when == ALWAYS or not self._hears:
            return Demand(most_hz, to_broker or self._to_broker)
        # The alert rules rely on this rate, so a viewer who asks for less does not lower it.
        idle_hz = 1 / LIVE_BROKER_EVERY_S
        asked_hz = max([idle_hz, *(demand.rate_hz for demand in demands)])
        return Demand(min(most_hz, asked_hz), to_broker or asked_hz == idle_hz)

    def _tell(self, *, at_once: bool = False) -> None:
        demand = self._demand()
        if at_once or demand != self._told:
            self._told = demand
            self._lane.follow(demand, at_once=at_once)
