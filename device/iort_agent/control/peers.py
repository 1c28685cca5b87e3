"""Messages between robots: those of others to our ROS topics, and the newest ones of ours to the others."""

from __future__ import annotations

import functools
import re
import threading
from typing import Callable, Mapping, Sequence

from iort_agent.control import Bridge
from iort_agent.control.config import ROBOT_IN_TOPIC, DownlinkConfig, FleetConfig, ShareConfig
from iort_agent.mqtt.rate_limiter import STEADY
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros.json_message import decode, encode
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.commands import FLEET_MAX_AGE_MS, FleetMessage, decode_fleet, encode_fleet
from iort_contract.ros.definition import Definition, parse
from iort_contract.topics import FLEET, parse_topic

# Each robot needs a ROS topic; a lab has fewer robots than this.
_MAX_ROBOTS = 64
# A message waits this long for the rate limiter, unless a newer one replaces it.
_NO_ROOM_S = 0.05
# ROS 2 allows no part of a topic's name that begins so.
_DIGIT_FIRST = re.compile(r"/\d")
# Of all shared topics.
_parse = functools.lru_cache(maxsize=64)(parse)


class _Heard:
    """The messages of one name."""

    def __init__(self, config: FleetConfig, definition: Definition) -> None:
        self.config, self.definition = config, definition
        self.passed: dict[str, int] = {}
        self._last: dict[str, tuple[str, int]] = {}
        self._robots: dict[str, str] = {}

    def rejection(self, robot: str, heard: FleetMessage, now_us: int) -> str | None:
        """Why a message may not pass; None if it may, and it counts as the newest from then on."""
        if now_us - heard.sent_us > self.config.max_age_s * 1e6:
            return "stale"
        # ROS names have no dash: a-b and a_b would share a topic.
        if self._robots.setdefault(robot.replace("-", "_"), robot) != robot:
            return "name_taken_in_ros"
        boot, seq = self._last.get(robot, (heard.boot, -1))
        if boot == heard.boot and heard.seq <= seq:
            return "repeated_or_out_of_order"
        if robot not in self._last and len(self._last) >= _MAX_ROBOTS:
            return "too_many_robots"
        self._last[robot] = (heard.boot, heard.seq)
        return None


class Peers:
    """Publishes other robots' messages. Raises `SourceError` for a ROS type that is not installed."""

    def __init__(self, config: DownlinkConfig, bridge: Bridge) -> None:
        self._bridge, self._graph = bridge, bridge.graph
        self._names = {
            name: _Heard(settings, self._graph.definition(settings.type)) for name, settings in config.fleet
        }
        for name in self._names:
            bridge.link.uplink.subscribe(f"{FLEET}/{bridge.link.namespace}/+/{name}", self._on_message)

    def report(self) -> dict[str, dict[str, int]]:
        """The passed messages of each name, by robot."""
        return {name: dict(heard.passed) for name, heard in self._names.items()}

    def _on_message(self, message: MqttMessage) -> None:
        topic = parse_topic(message.topic)
        if topic.robot == self._bridge.link.robot:
            return
        name = self._names[topic.name]
        what, now_us = f"{FLEET} {topic.name}", self._bridge.link.clock.now_us()
        try:
            heard = decode_fleet(message.payload)
            data = encode(name.definition, heard.message, now_us=now_us)
        except (ContractError, MessageError) as error:
            self._bridge.reject(what, "malformed", f"{topic.robot}: {error}")
            return
        offset_us = self._bridge.offset_us()
        if offset_us is not None and heard.offset_us is not None:
            # Compare both clocks with the cloud's. If one offset is unknown, compare them directly.
            now_us += offset_us - heard.offset_us
        reason = name.rejection(topic.robot, heard, now_us)
        if reason is None:
            ros_topic = name.config.topic.replace(ROBOT_IN_TOPIC, topic.robot.replace("-", "_"))
            if self._graph.ros == 2 and _DIGIT_FIRST.search(ros_topic):
                reason = "no_name_in_ros2"
            else:
                reason = self._publish(name, topic.robot, ros_topic, data)
        if reason is not None:
            self._bridge.reject(what, reason, f"{topic.robot}: {reason.replace('_', ' ')}")

    def _publish(self, name: _Heard, robot: str, topic: str, data: bytes) -> str | None:
        self._graph.advertise(topic, name.config.type)
        if not self._graph.publish(topic, data):
            return "no_ros"
        name.passed[robot] = name.passed.get(robot, 0) + 1
        return None


class _Shared:
    """One shared ROS topic. ``newest`` waits to be sent: connection header, bytes and time of arrival."""

    def __init__(self, ros_topic: str, config: ShareConfig, topic: str) -> None:
        self.ros_topic, self.topic = ros_topic, topic
        self.period_s = 1 / config.rate_hz
        self.due = 0.0
        self.seq = 0
        self.newest: tuple[Mapping[str, str], bytes, float] | None = None


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
            _Shared(topic, settings, self._link.topic(FLEET, settings.name)) for topic, settings in share
        ]
        for shared in self._shares:
            bridge.graph.subscribe(shared.ros_topic, functools.partial(self._on_ros, shared))

    def tick(self) -> float | None:
        """Send the messages that are due. Returns when to call again; None while no message waits."""
        with self._lock:
            for shared in self._shares:
                self._send(shared)
            return min((shared.due for shared in self._shares if shared.newest is not None), default=None)

    def report(self) -> dict[str, int]:
        """The sent messages of each ROS topic."""
        return {heard.ros_topic: heard.seq for heard in self._shares}

    def _on_ros(self, shared: _Shared, header: Mapping[str, str], data: bytes) -> None:
        with self._lock:
            waited = shared.newest is not None
            shared.newest = (header, data, self._clock.monotonic())
            self._send(shared)
            waits = shared.newest is not None
        # The thread knows of a message that waited before. Waking it for each of a thousand messages a second
        # would cost more than sending does.
        if waits and not waited:
            self._wake()

    def _send(self, shared: _Shared) -> None:
        now = self._clock.monotonic()
        if shared.newest is None or now < shared.due:
            return
        if not self._link.rate_limiter.may_go(STEADY, shared.topic, len(shared.newest[1])):
            shared.due = now + _NO_ROOM_S
            return
        (header, data, at), shared.newest = shared.newest, None
        if now - at > FLEET_MAX_AGE_MS / 1000 or not self._link.uplink.connected():
            return
        try:
            definition = _parse(header.get("type", ""), header.get("message_definition", ""))
            message = decode(definition, data)
            payload = encode_fleet(
                FleetMessage(self._boot, shared.seq, self._clock.now_us(), message, self._bridge.offset_us())
            )
        except (ContractError, MessageError) as error:
            self._bridge.reject(f"share {shared.ros_topic}", "cannot_be_sent", str(error))
            return
        shared.seq += 1
        shared.due = max(shared.due, now - shared.period_s / 2) + shared.period_s
        # A lost message is not repeated: the next one follows soon.
        self._link.publish(shared.topic, payload, qos=0)
