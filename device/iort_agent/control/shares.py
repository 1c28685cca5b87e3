"""The newest messages of our own ROS topics, sent to the other robots."""

from __future__ import annotations

import functools
import threading
from typing import Callable, Mapping, Sequence

from iort_agent.control.bridge import Bridge
from iort_agent.control.config import ShareConfig
from iort_agent.mqtt.rate_limiter import STEADY
from iort_agent.ros1.json_message import decode
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.control.commands import FLEET_MAX_AGE_MS, FleetMessage, encode_fleet
from iort_contract.ros1.definition import Definition, parse
from iort_contract.topics import FLEET

# A message waits this long for the rate limiter, unless a newer one replaces it.
_NO_ROOM_S = 0.05
_MAX_DEFINITIONS = 8


class _Share:
    """One shared ROS topic. ``newest`` waits to be sent: connection header, bytes and time of arrival."""

    def __init__(self, ros_topic: str, config: ShareConfig, topic: str) -> None:
        self.ros_topic, self.topic = ros_topic, topic
        self.period_s = 1 / config.rate_hz
        self.due = 0.0
        self.seq = 0
        self.newest: tuple[Mapping[str, str], bytes, float] | None = None
        self.definitions: dict[tuple[str, str], Definition] = {}

    def definition(self, header: Mapping[str, str]) -> Definition:
        key = (header.get("type", ""), header.get("message_definition", ""))
        if key not in self.definitions:
            if len(self.definitions) >= _MAX_DEFINITIONS:
                self.definitions.clear()
            self.definitions[key] = parse(*key)
        return self.definitions[key]


class Shares:
    """Sends each topic's newest message at its rate. ``wake`` is called when a message starts to wait."""

    def __init__(
        self,
        share: Sequence[tuple[str, ShareConfig]],
        bridge: Bridge,
        *,
        boot: str,
        wake: Callable[[], None],
    ) -> None:
        self._bridge, self._link, self._clock = bridge, bridge.link, bridge.link.clock
        self._boot, self._wake = boot, wake
        self._lock = threading.Lock()
        self._shares = [
            _Share(topic, settings, self._link.topic(FLEET, settings.name)) for topic, settings in share
        ]
        for one in self._shares:
            bridge.graph.subscribe(one.ros_topic, functools.partial(self._on_ros, one))

    def tick(self) -> float | None:
        """Send the messages that are due. Returns when to call again; None while no message waits."""
        with self._lock:
            for one in self._shares:
                self._send(one)
            return min((one.due for one in self._shares if one.newest is not None), default=None)

    def report(self) -> dict[str, int]:
        """The sent messages of each ROS topic."""
        return {one.ros_topic: one.seq for one in self._shares}

    def _on_ros(self, one: _Share, header: Mapping[str, str], data: bytes) -> None:
        with self._lock:
            waited = one.newest is not None
            one.newest = (header, data, self._clock.monotonic())
            self._send(one)
            waits = one.newest is not None
        # The thread knows of a message that waited before. Waking it for each of a thousand messages a second
        # would cost more than sending does.
        if waits and not waited:
            self._wake()

    def _send(self, one: _Share) -> None:
        now = self._clock.monotonic()
        if one.newest is None or now < one.due:
            return
        if not self._link.rate_limiter.may_go(STEADY, one.topic, len(one.newest[1])):
            one.due = now + _NO_ROOM_S
            return
        (header, data, at), one.newest = one.newest, None
        if now - at > FLEET_MAX_AGE_MS / 1000 or not self._link.uplink.connected():
            return
        try:
            message = decode(one.definition(header), data)
            payload = encode_fleet(
                FleetMessage(self._boot, one.seq, self._clock.now_us(), message, self._bridge.offset_us())
            )
        except (ContractError, MessageError) as error:
            self._bridge.reject(f"share {one.ros_topic}", "cannot_be_sent", str(error))
            return
        one.seq += 1
        one.due = max(one.due, now - one.period_s / 2) + one.period_s
        # A lost message is not repeated: the next one follows soon.
        self._link.publish(one.topic, payload, qos=0)
