"""Messages of other robots from the broker to ROS topics."""

from __future__ import annotations

from iort_agent.control.bridge import Bridge
from iort_agent.control.config import ROBOT_IN_TOPIC, DownlinkConfig, FleetConfig
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros1.json_message import encode
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.control.commands import FleetMessage, decode_fleet
from iort_contract.ros1.definition import Definition
from iort_contract.topics import FLEET, parse_topic

# Each robot needs a ROS topic; a lab has fewer robots than this.
_MAX_ROBOTS = 64


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
        return {name: dict(one.passed) for name, one in self._names.items()}

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
            self._graph.advertise(ros_topic, name.config.type)
            if self._graph.publish(ros_topic, data):
                name.passed[topic.robot] = name.passed.get(topic.robot, 0) + 1
            else:
                reason = "no_ros"
        if reason is not None:
            self._bridge.reject(what, reason, f"{topic.robot}: {reason.replace('_', ' ')}")
