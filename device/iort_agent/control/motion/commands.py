"""Commands from the broker to ROS topics. `iort_agent.control.motion.leases` decides which may pass."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, replace
from typing import Any, Callable, Mapping

from iort_agent.control.bridge import Bridge
from iort_agent.control.config import CommandConfig, DownlinkConfig
from iort_agent.control.motion.driving import drive_sample, limited
from iort_agent.control.motion.guard import Guard
from iort_agent.control.motion.leases import Leases, Limits
from iort_agent.errors import ConfigError
from iort_agent.mqtt.uplink import MqttMessage
from iort_agent.ros1.json_message import encode
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.messages.commands import Command, decode_command
from iort_contract.messages.driving import NO_GUARD, NO_ROS, SETTINGS_UNKNOWN, STOPPED, DriveLimits
from iort_contract.ros1.definition import Definition
from iort_contract.topics import ACCEPTED, CMD

_log = logging.getLogger(__name__)

# Between two samples of refused motions: others drive meanwhile.
_REFUSED_S = 0.1


@dataclass(frozen=True)
class Operator:
    """The operator's side of the commands.

    ``answer`` takes a command's name, the command, and why it was rejected (None: it passed). ``drove`` takes
    a sample of the stream `DRIVE_STREAM`. ``settings_known`` tells whether the operator's settings, with the
    emergency stop, are known on this connection.
    """

    answer: Callable[[str, Command, str | None], None]
    drove: Callable[[Mapping[str, Value]], None]
    settings_known: Callable[[], bool]


class _Command:
    """The commands of one name. ``limits`` are those of a stick, if it drives this command."""

    def __init__(
        self,
        name: str,
        config: CommandConfig,
        definition: Definition,
        skew_s: float,
        limits: DriveLimits | None,
    ) -> None:
        self.name, self.config, self.definition, self.limits = name, config, definition, limits
        motion = config.motion
        self.leases = Leases(Limits(config.max_age_s, skew_s, motion.lease_s if motion is not None else None))
        self.passed = self.stops = self.limited = 0
        self.stopping = False
        # The end of the lease that the guard knows.
        self.guarded: float | None = None
        # When the next refused motion becomes a sample.
        self.refused_due = 0.0

    def check(self, now_us: int) -> None:
        """Raise `ConfigError` if the stop, or what a stick drives, does not fit the ROS type."""
        try:
            self.stop(now_us)
        except MessageError as error:
            raise ConfigError(f"downlink.cmd.{self.name}.motion.stop: {error}") from error
        if self.limits is not None:
            try:
                self.data(self.limits.message(0.0, 0.0), now_us)
            except MessageError as error:
                raise ConfigError(
                    f"downlink.drive: {error}; downlink.cmd.{self.name}.partial must be true if the message "
                    "has other fields"
                ) from error

    def stop(self, now_us: int) -> bytes:
        fields = self.config.motion.stop if self.config.motion is not None else {}
        return encode(self.definition, fields, now_us=now_us, partial=True)

    def data(self, message: Mapping[str, Any], now_us: int) -> bytes:
        return encode(self.definition, message, now_us=now_us, partial=self.config.partial)

    def sample(self, command: Command, outcome: str, now: float) -> Mapping[str, Value]:
        left_s = self.leases.left_s(now)
        return drive_sample(command, outcome, self.leases.driver(now), left_s, self.limits)

    def report(self) -> dict[str, int]:
        counts = {"passed": self.passed, "stops": self.stops}
        return {**counts, "limited": self.limited} if self.limits is not None else counts


class Commands:
    """Publishes commands that may pass, and stops when a lease ends. ``wake`` is called when a stop may be
    due earlier. The ``guard`` knows the end of each lease before a command passes.

    Raises `SourceError` for a ROS type that is not installed, `ConfigError` for a stop that does not fit its
    type.
    """

    def __init__(
        self,
        config: DownlinkConfig,
        bridge: Bridge,
        *,
        operator: Operator,
        guard: Guard | None,
        wake: Callable[[], None],
    ) -> None:
        self._bridge, self._graph, self._clock = bridge, bridge.graph, bridge.link.clock
        self._operator, self._guard, self._wake = operator, guard, wake
        self._lock = threading.Lock()
        self._commands: dict[str, _Command] = {}
        stick = config.drive_limits()
        for name, settings in config.cmd:
            limits = stick if stick is not None and stick.command == name else None
            definition = self._graph.definition(settings.type)
            command = _Command(name, settings, definition, config.clock_skew_s, limits)
            command.check(self._clock.now_us())
            topic = bridge.link.topic(CMD, name)
            self._commands[topic] = command
            self._graph.advertise(settings.topic, settings.type)
            bridge.link.uplink.subscribe(topic, self._on_message)
        bridge.link.uplink.on_connection(self._on_connection)

    def set_stopped(self, stopped: bool) -> None:  # noqa: FBT001 - a setting's value
        """Begin or release the emergency stop of every motion."""
        now = self._clock.monotonic()
        with self._lock:
            for command in self._commands.values():
                if command.config.motion is None:
                    continue
                if stopped:
                    command.leases.hold(now)
                else:
                    command.leases.free()
        self.tick()
        self._wake()

    def halt(self) -> None:
        """Stop all motion, and let no further command pass."""
        with self._lock:
            for command in self._commands.values():
                command.leases.close(self._clock.monotonic())
        self.tick()

    def tick(self) -> float | None:
        """Publish the stops that are due. Returns when to call again; None while nothing moves."""
        ended: set[str] = set()
        stopped: list[Mapping[str, Value]] = []
        with self._lock:
            now = self._clock.monotonic()
            for command in self._commands.values():
                if command.leases.stop_due(now):
                    if not command.stopping:
                        stopped += self._begin_stop(command, now)
                    data = command.stop(self._clock.now_us())
                    command.stops += self._graph.publish(command.config.topic, data)
                elif command.stopping and command.leases.next_due() is None:
                    command.stopping = False
                    ended.add(command.config.topic)
                self._tell_guard(command)
            due = [
                (at, command.config.topic)
                for command in self._commands.values()
                if (at := command.leases.next_due()) is not None
            ]
            # Under the lock, so that no command that has just passed is released.
            for topic in ended.difference(topic for _, topic in due):
                self._graph.release(topic)
            # After the stops, since it may have to start a process.
            if self._guard is not None:
                self._guard.tick()
        for sample in stopped:
            self._operator.drove(sample)
        return min((at for at, _ in due), default=None)

    def report(self) -> dict[str, Any]:
        """The passed and the limited commands and the published stops, by name."""
        return {one.name: one.report() for one in self._commands.values()}

    def alarms(self) -> list[str]:
        """Why no motion may pass."""
        found = []
        if any(command.leases.held for command in self._commands.values()):
            found.append("emergency stop: no motion until an operator releases it")
        if self.guarded() is False:
            found.append("the guard does not run yet: no motion until it does")
        return found

    def guarded(self) -> bool | None:
        """Whether the guard would stop the robot; None if it needs none."""
        with self._lock:
            return None if self._guard is None else self._guard.ready()

    def _tell_guard(self, command: _Command) -> bool:
        """Tell the guard the end of the command's lease, if it is another; whether that was possible."""
        ends = command.leases.ends
        if self._guard is None or ends == command.guarded:
            return True
        command.guarded = ends
        return self._guard.tell(command.name, ends)

    def _begin_stop(self, command: _Command, now: float) -> list[Mapping[str, Value]]:
        """Note that a stop begins; the sample of it, if somebody drove before."""
        command.stopping = True
        last = command.leases.last
        _log.warning("command %s: %s, stopping", command.name, command.leases.why_stopped())
        return [] if last is None else [command.sample(last, STOPPED, now)]

    def _unready(self) -> str | None:
        """Why no motion may pass yet."""
        if not self._operator.settings_known():
            return SETTINGS_UNKNOWN
        return NO_GUARD if self._guard is not None and not self._guard.ready() else None

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
        if command.limits is not None:
            within, beyond = limited(offered.message, command.limits)
            offered = replace(offered, message=within)
            command.limited += beyond
        rejection, sample = self._offer(command, offered)
        if rejection is not None:
            self._bridge.reject(message.topic, *rejection)
        if offered.answer:
            self._operator.answer(command.name, offered, rejection[1] if rejection is not None else None)
        if sample is not None:
            self._operator.drove(sample)
        self._wake()

    def _offer(
        self, command: _Command, offered: Command
    ) -> tuple[tuple[str, str] | None, Mapping[str, Value] | None]:
        """Publish the command if it may pass. Returns the reason if not, as a word and as a text, and the
        sample of a motion."""
        try:
            data = command.data(offered.message, self._clock.now_us())
        except MessageError as error:
            return ("malformed", str(error)), None
        moves = command.config.motion is not None
        # All times under the lock, for which the command may have waited.
        with self._lock:
            now, now_us = self._clock.monotonic(), self._clock.now_us()
            offset = self._bridge.offset()
            uncertainty_us = None
            if offset is not None:
                now_us += round(offset.offset_ms * 1000)
                uncertainty_us = round(offset.uncertainty_ms * 1000)
            reason = self._unready() if moves else None
            if reason is None:
                reason = command.leases.offer(offered, now_us=now_us, uncertainty_us=uncertainty_us, now=now)
            # Before the robot moves.
            if reason is None and not self._tell_guard(command):
                command.leases.cut(now)
                reason = NO_GUARD
            if reason is None and not self._graph.publish(command.config.topic, data):
                reason = NO_ROS
            command.passed += reason is None
            sample = None
            if moves and (reason is None or now >= command.refused_due):
                command.refused_due = now + _REFUSED_S if reason is not None else command.refused_due
                sample = command.sample(offered, reason or ACCEPTED, now)
        if reason is None:
            return None, sample
        ago_s = (now_us - offered.sent_us) / 1e6
        by = f"to within {uncertainty_us / 1e6:.3f} s" if uncertainty_us is not None else "by its own clock"
        return (reason, f"{reason.replace('_', ' ')}, sent {ago_s:.3f} s ago, {by}"), sample
