"""Commands from the broker to ROS topics. `iort_agent.control.leases` decides which may pass."""

from __future__ import annotations

import logging
import threading
from typing import Any, Callable, Optional

from iort_agent.control.bridge import Bridge
from iort_agent.control.config import CommandConfig, DownlinkConfig
from iort_agent.control.leases import Leases, Limits
from iort_agent.errors import ConfigError
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros1.json_message import encode
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.commands import Command, decode_command
from iort_contract.ros1.definition import Definition
from iort_contract.topics import CMD

_log = logging.getLogger(__name__)

# Takes a command's name, the command, and why it was rejected (None: it passed).
Answer = Callable[[str, Command, Optional[str]], None]


class _Command:
    """The commands of one name."""

    def __init__(self, name: str, config: CommandConfig, definition: Definition, skew_s: float) -> None:
        self.name, self.config, self.definition = name, config, definition
        motion = config.motion
        self.leases = Leases(Limits(config.max_age_s, skew_s, motion.lease_s if motion is not None else None))
        self.passed = self.stops = 0
        self.stopping = False

    def stop(self, now_us: int) -> bytes:
        fields = self.config.motion.stop if self.config.motion is not None else {}
        return encode(self.definition, fields, now_us=now_us, partial=True)


class Commands:
    """Publishes commands that may pass, and stops when a lease ends. ``wake`` is called when a stop may be
    due earlier; ``answer`` for each command that asks for an answer.

    Raises `SourceError` for a ROS type that is not installed, `ConfigError` for a stop that does not fit its
    type.
    """

    def __init__(
        self, config: DownlinkConfig, bridge: Bridge, *, answer: Answer, wake: Callable[[], None]
    ) -> None:
        self._bridge, self._graph, self._clock = bridge, bridge.graph, bridge.link.clock
        self._answer, self._wake = answer, wake
        self._lock = threading.Lock()
        self._commands: dict[str, _Command] = {}
        for name, settings in config.cmd:
            command = _Command(name, settings, self._graph.definition(settings.type), config.clock_skew_s)
            try:
                command.stop(self._clock.now_us())
            except MessageError as error:
                raise ConfigError(f"downlink.cmd.{name}.motion.stop: {error}") from error
            topic = bridge.link.topic(CMD, name)
            self._commands[topic] = command
            self._graph.advertise(settings.topic, settings.type)
            bridge.link.uplink.subscribe(topic, self._on_message)
        bridge.link.uplink.on_connection(self._on_connection)

    def halt(self) -> None:
        """Stop all motion, and let no further command pass."""
        with self._lock:
            for command in self._commands.values():
                command.leases.close(self._clock.monotonic())
        self.tick()

    def tick(self) -> float | None:
        """Publish the stops that are due. Returns when to call again; None while nothing moves."""
        ended: set[str] = set()
        with self._lock:
            for command in self._commands.values():
                if command.leases.stop_due(self._clock.monotonic()):
                    if not command.stopping:
                        _log.warning("command %s: nobody renews it, stopping", command.name)
                    command.stopping = True
                    data = command.stop(self._clock.now_us())
                    command.stops += self._graph.publish(command.config.topic, data)
                elif command.stopping and command.leases.next_due() is None:
                    command.stopping = False
                    ended.add(command.config.topic)
            due = [
                (at, command.config.topic)
                for command in self._commands.values()
                if (at := command.leases.next_due()) is not None
            ]
            # Under the lock, so that no command that has just passed is released.
            for topic in ended.difference(topic for _, topic in due):
                self._graph.release(topic)
        return min((at for at, _ in due), default=None)

    def report(self) -> dict[str, Any]:
        """The passed commands and the published stops, by name."""
        return {one.name: {"passed": one.passed, "stops": one.stops} for one in self._commands.values()}

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - as the uplink calls it
        if connected:
            return
        with self._lock:
            for command in self._commands.values():
                command.leases.cut(self._clock.monotonic())
        self.tick()
        self._wake()

    def _on_message(self, message: MqttMessage) -> None:
        command = self._commands[message.topic]
        try:
            offered = decode_command(message.payload)
        except ContractError as error:
            self._bridge.reject(message.topic, "malformed", str(error))
            return
        rejection = self._offer(command, offered)
        if rejection is not None:
            self._bridge.reject(message.topic, *rejection)
        if offered.answer:
            self._answer(command.name, offered, rejection[1] if rejection is not None else None)
        self._wake()

    def _offer(self, command: _Command, offered: Command) -> tuple[str, str] | None:
        """Publish the command if it may pass; otherwise return the reason, as a word and as a text."""
        now_us = self._clock.now_us()
        try:
            data = encode(command.definition, offered.message, now_us=now_us, partial=command.config.partial)
        except MessageError as error:
            return "malformed", str(error)
        offset = self._bridge.offset()
        uncertainty_us = None
        if offset is not None:
            now_us += round(offset.offset_ms * 1000)
            uncertainty_us = round(offset.uncertainty_ms * 1000)
        with self._lock:
            reason = command.leases.offer(
                offered, now_us=now_us, uncertainty_us=uncertainty_us, now=self._clock.monotonic()
            )
            if reason is None:
                if self._graph.publish(command.config.topic, data):
                    command.passed += 1
                    return None
                reason = "no_ros"
        ago_s = (now_us - offered.sent_us) / 1e6
        by = f"to within {uncertainty_us / 1e6:.3f} s" if uncertainty_us is not None else "by its own clock"
        return reason, f"{reason.replace('_', ' ')}, sent {ago_s:.3f} s ago, {by}"
