"""From the broker to ROS and between robots: commands, other robots' messages, and our own to them.

`iort_agent.control.config` says what of it a robot wants. What comes in is checked against the ROS type's
own definition and refused, counted and, once a minute, logged where it does not fit. Motion is under
`iort_agent.control.leases`.
"""

from __future__ import annotations

import functools
import logging
import threading
from typing import Any, Callable, Iterable, Mapping, Optional, Sequence

from iort_agent.clock import Clock
from iort_agent.control.config import ROBOT_IN_TOPIC, CommandConfig, DownlinkConfig, FleetConfig, ShareConfig
from iort_agent.control.leases import Leases, Limits
from iort_agent.errors import ConfigError, UplinkError
from iort_agent.lanes.clock_offset import Offset
from iort_agent.mqtt.uplink import Message, Uplink
from iort_agent.rate_limiter import STEADY, Allowance
from iort_agent.ros1.json_message import decode, encode
from iort_agent.ros1.node import DEFAULT_NODE, Graph
from iort_agent.ros1.node import shared as shared_node
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.throttled_log import Seldom
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.commands import (
    FLEET_MAX_AGE_MS,
    Command,
    FleetMessage,
    decode_command,
    decode_fleet,
    encode_fleet,
)
from iort_contract.ros1.definition import Definition, parse
from iort_contract.topics import CMD, FLEET, build_topic, check_namespace, parse_topic

_log = logging.getLogger(__name__)

_IDLE_S = 1.0
# A message that the connection has no room for waits so long, unless a newer one replaces it.
_NO_ROOM_S = 0.05
# Each robot heard becomes a ROS topic; a lab has fewer than this.
_MAX_ROBOTS = 64
_MAX_DEFINITIONS = 8

# Takes a command's name, the command and None or why it was refused.
Answer = Callable[[str, Command, Optional[str]], None]


def make_downlink(
    config: DownlinkConfig,
    share: Sequence[tuple[str, ShareConfig]],
    *,
    sources: Iterable[object],
    clock: Clock,
    graph: Graph | None = None,
    **shared: Any,
) -> Downlink | None:
    """The downlink of a configuration that has one, by default in the graph of the sources' ROS node.

    Raises as `Downlink`, and `SourceError` without rospy.
    """
    if not (config.cmd or config.fleet or share):
        return None
    if graph is None:
        node = next((source.node for source in sources if isinstance(source, Ros1Config)), DEFAULT_NODE)
        graph = shared_node(node, clock)
    return Downlink(config, share, clock=clock, graph=graph, **shared)


class Downlink:
    """Made before the uplink starts; `start` begins, `halt` stops what moves, `close` ends it.
    ``offset`` is the cloud's clock against ours, where it is known well enough (`ClockOffset.known`);
    ``answer`` is told what became of the commands that ask for it.

    Raises `SourceError` where a ROS type is not installed, `ConfigError` where a stop is not of its type.
    """

    def __init__(
        self,
        config: DownlinkConfig,
        share: Sequence[tuple[str, ShareConfig]],
        *,
        robot: str,
        namespace: str,
        boot: str,
        uplink: Uplink,
        clock: Clock,
        allowance: Allowance,
        graph: Graph,
        offset: Callable[[], Offset | None],
        answer: Answer,
    ) -> None:
        self._robot = robot
        self._answer = answer
        self._offset = offset
        self._clock = clock
        self._graph = graph
        self._seldom = Seldom(_log, clock)
        self._lock = threading.Lock()
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="downlink", daemon=True)
        self._commands = {
            build_topic(CMD, robot, name, namespace): _Command(
                name, settings, graph.definition(settings.type), config.clock_skew_s, clock
            )
            for name, settings in config.cmd
        }
        self._fleet = {
            name: _Fleet(settings, graph.definition(settings.type)) for name, settings in config.fleet
        }
        self._shares = [
            _Share(topic, settings, build_topic(FLEET, robot, settings.name, namespace), boot)
            for topic, settings in share
        ]
        self._uplink, self._allowance = uplink, allowance
        for topic, command in self._commands.items():
            graph.advertise(command.config.topic, command.config.type)
            uplink.subscribe(topic, self._on_command)
        for name in self._fleet:
            uplink.subscribe(f"{FLEET}/{check_namespace(namespace)}/+/{name}", self._on_fleet)
        for shared in self._shares:
            graph.subscribe(shared.ros_topic, functools.partial(self._on_ros, shared))
        uplink.on_connection(self._on_connection)

    def start(self) -> None:
        """Join the ROS graph and begin."""
        self._graph.start()
        self._thread.start()

    def halt(self) -> None:
        """Stop what moves, and let no command pass any more; stops are said again until `close`."""
        with self._lock:
            for command in self._commands.values():
                command.leases.close(self._clock.monotonic())
            self._say_stops()
        self._wake.set()

    def close(self) -> None:
        """Stop what moves, every stop said, and leave the ROS graph."""
        self.halt()
        self._end.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        while self._stops_due():
            self._clock.wait(threading.Event(), max(0.0, min(self._stops_due()) - self._clock.monotonic()))
            self.tick()
        self._graph.close()

    def tick(self) -> float:
        """Publish what is due, stops and shares; seconds until something is due again."""
        with self._lock:
            self._say_stops()
            now = self._clock.monotonic()
            due = self._stops_due()
            for shared in self._shares:
                self._send(shared, now)
                if shared.newest is not None:
                    due.append(shared.due)
        return max(0.0, min(due, default=now + _IDLE_S) - now)

    def report(self) -> dict[str, Any]:
        """What became of everything."""
        return {
            "commands": {
                command.name: {"passed": command.passed, "stops": command.stops}
                for command in self._commands.values()
            },
            "fleet": {name: dict(fleet.passed) for name, fleet in self._fleet.items()},
            "shared": {shared.ros_topic: shared.seq for shared in self._shares},
            "refused": self._seldom.counts(),
            "waits": self.waits(),
        }

    def waits(self) -> str | None:
        """What the commands wait for; None if they do not wait."""
        return self._graph.waits()

    def _run(self) -> None:
        while not self._end.is_set():
            self._wake.clear()
            wait_s = self.tick()
            if not self._end.is_set():
                self._clock.wait(self._wake, min(wait_s, _IDLE_S))

    # Commands.

    def _on_command(self, message: Message) -> None:
        command = self._commands[message.topic]
        try:
            offered = decode_command(message.payload)
        except ContractError as error:
            self._refuse(message.topic, "malformed", str(error))
            return
        refusal = self._offer(command, offered)
        if refusal is not None:
            self._refuse(message.topic, *refusal)
        if offered.answer:
            self._answer(command.name, offered, refusal[1] if refusal is not None else None)
        self._wake.set()

    def _offer(self, command: _Command, offered: Command) -> tuple[str, str] | None:
        """Publish the command, or say why not: the reason in a word, and for a person."""
        now_us = self._clock.now_us()
        try:
            data = encode(command.definition, offered.message, now_us=now_us, partial=command.config.partial)
        except MessageError as error:
            return "malformed", str(error)
        offset = self._offset()
        wrong_us = None
        if offset is not None:
            now_us += round(offset.offset_ms * 1000)
            wrong_us = round(offset.uncertainty_ms * 1000)
        with self._lock:
            refusal = command.leases.offer(
                offered, now_us=now_us, wrong_us=wrong_us, now=self._clock.monotonic()
            )
            if refusal is None:
                if self._graph.publish(command.config.topic, data):
                    command.passed += 1
                    return None
                refusal = "no_ros"
        ago_s = (now_us - offered.sent_us) / 1e6
        by = f"to within {wrong_us / 1e6:.3f} s" if wrong_us is not None else "by its own clock"
        return refusal, f"{refusal.replace('_', ' ')}, sent {ago_s:.3f} s ago, {by}"

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - as the uplink calls it
        if connected:
            return
        with self._lock:
            for command in self._commands.values():
                command.leases.cut(self._clock.monotonic())
            self._say_stops()
        self._wake.set()

    def _stops_due(self) -> list[float]:
        """When leases end or stops are to be said again, of the commands that move or are being stopped."""
        due = [command.leases.next_due() for command in self._commands.values()]
        return [at for at in due if at is not None]

    def _say_stops(self) -> None:
        for command in self._commands.values():
            if command.leases.stop_due(self._clock.monotonic()):
                if not command.stopping:
                    _log.warning("command %s: nobody renews it, stopping", command.name)
                command.stopping = True
                command.stops += self._graph.publish(command.config.topic, command.stop(self._clock.now_us()))
            elif command.leases.next_due() is None:
                command.stopping = False

    # Other robots.

    def _on_fleet(self, message: Message) -> None:
        topic = parse_topic(message.topic)
        fleet = self._fleet[topic.name]
        if topic.robot == self._robot:
            return
        try:
            heard = decode_fleet(message.payload)
            now_us = self._clock.now_us()
            data = encode(fleet.definition, heard.message, now_us=now_us)
        except (ContractError, MessageError) as error:
            self._refuse(f"{FLEET} {topic.name}", "malformed", f"{topic.robot}: {error}")
            return
        offset = self._offset()
        if offset is not None and heard.offset_us is not None:
            # Both clocks against the cloud's; otherwise they must do as they are.
            now_us += round(offset.offset_ms * 1000) - heard.offset_us
        refusal = fleet.refusal(topic.robot, heard, now_us)
        if refusal is None:
            ros_topic = fleet.config.topic.replace(ROBOT_IN_TOPIC, topic.robot.replace("-", "_"))
            self._graph.advertise(ros_topic, fleet.config.type)
            if self._graph.publish(ros_topic, data):
                fleet.passed[topic.robot] = fleet.passed.get(topic.robot, 0) + 1
            else:
                refusal = "no_ros"
        if refusal is not None:
            self._refuse(f"{FLEET} {topic.name}", refusal, f"{topic.robot}: {refusal.replace('_', ' ')}")

    def _refuse(self, what: str, reason: str, why: str) -> None:
        self._seldom.warn(f"{what} {reason}", f"{what}: refused: {why}")

    # Our own messages to them.

    def _on_ros(self, shared: _Share, header: Mapping[str, str], data: bytes) -> None:
        with self._lock:
            # Of a message that waits already, the thread knows; waking it a thousand times a second
            # would cost more than sending does.
            known = shared.newest is not None
            shared.newest = (header, data, self._clock.monotonic())
            self._send(shared, self._clock.monotonic())
            waits = shared.newest is not None
        if waits and not known:
            self._wake.set()

    def _send(self, shared: _Share, now: float) -> None:
        if shared.newest is None or now < shared.due:
            return
        if not self._allowance.may_go(STEADY, shared.topic, len(shared.newest[1])):
            shared.due = now + _NO_ROOM_S
            return
        (header, data, at), shared.newest = shared.newest, None
        if now - at > FLEET_MAX_AGE_MS / 1000 or not self._uplink.connected():
            return
        try:
            payload = shared.encode(header, data, self._clock.now_us(), self._offset())
        except (ContractError, MessageError) as error:
            self._refuse(f"share {shared.ros_topic}", "cannot_be_sent", str(error))
            return
        shared.seq += 1
        shared.due = max(shared.due, now - shared.period_s / 2) + shared.period_s
        self._allowance.spend(shared.topic, payload)
        self._uplink.publish(shared.topic, payload, qos=0, done=_ignore)


class _Command:
    def __init__(
        self, name: str, config: CommandConfig, definition: Definition, skew_s: float, clock: Clock
    ) -> None:
        self.name, self.config, self.definition = name, config, definition
        motion = config.motion
        self.leases = Leases(Limits(config.max_age_s, skew_s, motion.lease_s if motion is not None else None))
        self.passed = self.stops = 0
        self.stopping = False
        try:
            self.stop(clock.now_us())
        except MessageError as error:
            raise ConfigError(f"downlink.cmd.{name}.motion.stop: {error}") from error

    def stop(self, now_us: int) -> bytes:
        fields = self.config.motion.stop if self.config.motion is not None else {}
        return encode(self.definition, fields, now_us=now_us, partial=True)


class _Fleet:
    def __init__(self, config: FleetConfig, definition: Definition) -> None:
        self.config, self.definition = config, definition
        self.passed: dict[str, int] = {}
        self._last: dict[str, tuple[str, int]] = {}
        self._robots: dict[str, str] = {}

    def refusal(self, robot: str, heard: FleetMessage, now_us: int) -> str | None:
        """Why a message may not pass; None if it may, which then counts as the newest."""
        if now_us - heard.sent_us > self.config.max_age_s * 1e6:
            return "stale"
        # ROS names have no dash: a-b and a_b would be one robot.
        if self._robots.setdefault(robot.replace("-", "_"), robot) != robot:
            return "name_taken_in_ros"
        boot, seq = self._last.get(robot, (heard.boot, -1))
        if boot == heard.boot and heard.seq <= seq:
            return "repeated_or_out_of_order"
        if robot not in self._last and len(self._last) >= _MAX_ROBOTS:
            return "too_many_robots"
        self._last[robot] = (heard.boot, heard.seq)
        return None


class _Share:
    def __init__(self, ros_topic: str, config: ShareConfig, topic: str, boot: str) -> None:
        self.ros_topic, self.topic = ros_topic, topic
        self.period_s = 1 / config.rate_hz
        self.due = 0.0
        self.seq = 0
        self.newest: tuple[Mapping[str, str], bytes, float] | None = None
        self._boot = boot
        self._definitions: dict[tuple[str, str], Definition] = {}

    def encode(self, header: Mapping[str, str], data: bytes, now_us: int, offset: Offset | None) -> bytes:
        key = (header.get("type", ""), header.get("message_definition", ""))
        if key not in self._definitions:
            if len(self._definitions) >= _MAX_DEFINITIONS:
                self._definitions.clear()
            self._definitions[key] = parse(*key)
        message = decode(self._definitions[key], data)
        offset_us = round(offset.offset_ms * 1000) if offset is not None else None
        return encode_fleet(FleetMessage(self._boot, self.seq, now_us, message, offset_us))


def _ignore(_: UplinkError | None) -> None:
    """Only the newest matters, and the next one is soon to come."""
