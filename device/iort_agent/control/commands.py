"""Commands from the broker to ROS topics, and who drove. `iort_agent.control.leases` tells which may pass."""

from __future__ import annotations

import logging
import math
import threading
from dataclasses import dataclass, replace
from typing import Any, Callable, Mapping, NamedTuple, Sequence

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.schema import did_you_mean
from iort_agent.control import Bridge
from iort_agent.control.config import CommandConfig, DownlinkConfig
from iort_agent.control.guard import Guard
from iort_agent.control.leases import STOP_AHEAD_MS, Leases, Limits
from iort_agent.errors import ConfigError
from iort_agent.mqtt.uplink import Link, MqttMessage, OnMessage
from iort_agent.ros.json_message import encode
from iort_contract.limits import ContractError, MessageError, Value
from iort_contract.messages.commands import (
    NO_COMMAND,
    NO_GUARD,
    NO_ROS,
    SETTINGS_UNKNOWN,
    STOPPED,
    Command,
    DriveLimits,
    decode_command,
)
from iort_contract.ros.definition import Definition
from iort_contract.topics import ACCEPTED, CMD

_log = logging.getLogger(__name__)

# Between two samples of refused motions: others drive meanwhile.
_REFUSED_S = 0.1
# rospy hands a stop to threads of its own. An agent that is killed before it is written must leave it to the
# guard, which publishes its own `STOP_AHEAD_MS` after the agent's.
_WRITTEN_S = 0.02


def limited(message: Mapping[str, Any], limits: DriveLimits) -> tuple[Mapping[str, Any], bool]:
    """The message with speed and steering within the limits, and whether one was beyond.

    What is no finite number stays, as it does not fit the ROS type either.
    """
    beyond = False
    for path, most in ((limits.speed, limits.max_speed_mps), (limits.steering, limits.max_steering_rad)):
        value = _number_at(message, path)
        if value is not None and not -most <= value <= most:
            message, beyond = _with(message, path.split("."), max(-most, min(most, value))), True
    return message, beyond


def _number_at(message: Any, path: str) -> float | None:
    for name in path.split("."):
        message = message.get(name) if isinstance(message, dict) else None
    number = type(message) in (int, float) and abs(message) != math.inf
    return message if number else None


def _with(message: Mapping[str, Any], path: list[str], value: float) -> dict[str, Any]:
    name, *below = path
    return {**message, name: _with(message[name], below, value) if below else value}


class Sight(NamedTuple):
    """What a robot with video knows of its pictures. ``age_ms`` tells the age of the picture with a number at
    a monotonic time; None for one that it does not know. It must answer at once."""

    max_age_ms: int
    age_ms: Callable[[int, float], float | None]


class Motion:
    """What moves the robot by one ROS topic: its lease, whichever commands renew it, and its stop."""

    def __init__(self, topic: str, stop: Mapping[str, Any], definition: Definition) -> None:
        self.topic, self.leases = topic, Leases()
        self.stop_message, self._definition = stop, definition
        self.stopping = False
        # What the guard knows: the lease's end, and whether an emergency stop holds.
        self.guarded: tuple[float | None, bool] = (None, False)
        # The name of the newest command that passed, and the age of its picture when it came.
        self.last: Named | None = None
        self.picture_ms: float | None = None
        self.stops = 0
        # The newest stop could not be published: the agent is not in the ROS graph.
        self.unheard = False
        # When the first stop is written, for sure.
        self.written = 0.0

    def next_due(self, now: float) -> float | None:
        """When something is to be done next; None while nothing moves."""
        due = self.leases.next_due()
        return self.written if now < self.written and (due is None or self.written < due) else due

    def stop(self, now_us: int) -> bytes:
        return encode(self._definition, self.stop_message, now_us=now_us, partial=True)


class Named:
    """The commands of one name. ``motion`` is what they move, ``limits`` are those of a stick, if it drives
    this command."""

    def __init__(
        self,
        name: str,
        config: CommandConfig,
        definition: Definition,
        *,
        skew_s: float,
        motion: Motion | None,
        limits: DriveLimits | None,
        picture_ms: float | None,
    ) -> None:
        self.name, self.config, self.definition = name, config, definition
        self.motion, self.limits = motion, limits
        lease_s = config.motion.lease_s if config.motion is not None else None
        self.allowed = Limits(config.max_age_s, skew_s, lease_s, picture_ms)
        self.leases = motion.leases if motion is not None else Leases()
        self.passed = self.limited = 0
        # When the next refused motion becomes a sample.
        self.refused_due = 0.0

    def check(self, now_us: int) -> None:
        """Raise `ConfigError` if the stop, or what a stick drives, does not fit the ROS type."""
        try:
            if self.motion is not None:
                self.motion.stop(now_us)
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

    def data(self, message: Mapping[str, Any], now_us: int) -> bytes:
        return encode(self.definition, message, now_us=now_us, partial=self.config.partial)

    def sample(
        self, command: Command, outcome: str, now: float, picture_ms: float | None
    ) -> Mapping[str, Value]:
        """A sample of the stream `DRIVE_STREAM`; speed and steering are what the robot was told.
        ``picture_ms`` is the age of the command's picture when it came."""
        driver, limits = self.leases.driver(now), self.limits
        speed = steering = None
        if limits is not None and outcome in (ACCEPTED, STOPPED):
            # A field that the message leaves out is zero; a stop is.
            message = {} if outcome == STOPPED else command.message
            speed, steering = (_number_at(message, path) or 0.0 for path in (limits.speed, limits.steering))
        return {
            "session": command.session,
            "by": command.by,
            "seq": command.seq,
            "sent_us": command.sent_us,
            "outcome": outcome,
            "driver": driver.session if driver is not None else None,
            "driver_by": driver.by if driver is not None else None,
            "lease_left_ms": round(self.leases.left_s(now) * 1000),
            "speed": speed,
            "steering": steering,
            "frame": command.frame,
            # A picture that is no longer known is infinitely old.
            "frame_age_ms": round(picture_ms, 1)
            if picture_ms is not None and picture_ms < math.inf
            else None,
            "blind": command.blind,
        }

    def report(self) -> dict[str, int]:
        counts = {"passed": self.passed, "stops": self.motion.stops if self.motion is not None else 0}
        return {**counts, "limited": self.limited} if self.limits is not None else counts


@dataclass(frozen=True)
class Operator:
    """The operator's side of the commands.

    ``answer`` takes a command's name, the command, and why it was rejected (None: it passed). ``drove`` takes
    a sample of the stream `DRIVE_STREAM`. ``settings_known`` tells whether the operator's settings, with the
    emergency stop, are known on this connection.
    """

    answer: Callable[[str, Command, str | None], None]
    drove: Callable[[Mapping[str, Value]], object]
    settings_known: Callable[[], bool]


def refuser(
    known: Sequence[str], rejections: ThrottledLog, answer: Callable[[str, Command, str | None], None]
) -> OnMessage:
    """Answers commands that a robot does not have, so that who sent one need not wait."""
    names = f"known: {', '.join(known)}" if known else "car.yaml has no downlink.cmd"

    def refuse(message: MqttMessage) -> None:
        name = message.topic.rsplit("/", 1)[-1]
        reason = f"{NO_COMMAND.replace('_', ' ')}{did_you_mean(name, known)}; {names}"
        try:
            command = decode_command(message.payload)
        except ContractError as error:
            rejections.warn(f"{CMD} malformed", f"{message.topic}: rejected: {error}")
            return
        rejections.warn(f"{CMD} {NO_COMMAND}", f"{message.topic}: rejected: {reason}")
        if command.answer:
            answer(name, command, reason)

    return refuse


def refuse_commands(link: Link, answer: Callable[[str, Command, str | None], None]) -> None:
    """Answer every command to a robot that takes none."""
    link.uplink.subscribe(_all(link), refuser((), ThrottledLog(_log, link.clock), answer))


def _all(link: Link) -> str:
    return f"{CMD}/{link.namespace}/{link.robot}/+"


class Commands:
    """Publishes commands that may pass, and stops when a lease ends. ``wake`` is called when a stop may be
    due earlier. The ``guard`` knows the end of each lease before a command passes. With ``sight`` a motion
    passes only by a picture, or blind.

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
        sight: Sight | None = None,
    ) -> None:
        self._sight = sight
        self._bridge, self._graph, self._clock = bridge, bridge.graph, bridge.link.clock
        self._operator, self._guard, self._wake = operator, guard, wake
        self._lock = threading.Lock()
        self._commands: dict[str, Named] = {}
        self._motions: dict[str, Motion] = {}
        stick = config.drive_limits()
        for name, settings in config.cmd:
            limits = stick if stick is not None and stick.command == name else None
            definition = self._graph.definition(settings.type)
            motion = None
            if settings.motion is not None:
                moved = Motion(settings.topic, settings.motion.stop, definition)
                motion = self._motions.setdefault(settings.topic, moved)
            command = Named(
                name,
                settings,
                definition,
                skew_s=config.clock_skew_s,
                motion=motion,
                limits=limits,
                picture_ms=sight.max_age_ms if sight is not None else None,
            )
            command.check(self._clock.now_us())
            self._commands[bridge.link.topic(CMD, name)] = command
            self._graph.advertise(settings.topic, settings.type)
        self._refuse = refuser([name for name, _ in config.cmd], bridge.rejections, operator.answer)
        bridge.link.uplink.subscribe(_all(bridge.link), self._on_message)
        bridge.link.uplink.on_connection(self._on_connection)

    def set_stopped(self, stopped: bool) -> None:  # noqa: FBT001 - a setting's value
        """Begin or release the emergency stop of every motion."""
        now = self._clock.monotonic()
        with self._lock:
            for motion in self._motions.values():
                if stopped:
                    motion.leases.hold(now)
                else:
                    motion.leases.free()
                # Before the first stop, after which the agent may die.
                self._tell_guard(motion)
        self.tick()
        self._wake()

    def halt(self, *, keep_stop: bool) -> None:
        """Stop all motion, and let no further command pass; ``keep_stop`` goes on with an emergency stop."""
        with self._lock:
            for command in self._commands.values():
                command.leases.close(self._clock.monotonic(), free=not keep_stop)
        self.tick()

    def tick(self) -> float | None:
        """Publish the stops that are due. Returns when to call again; None while nothing moves."""
        stopped: list[Mapping[str, Value]] = []
        with self._lock:
            now = self._clock.monotonic()
            for motion in self._motions.values():
                if motion.leases.stop_due(now):
                    if not motion.stopping:
                        stopped += self._begin_stop(motion, now)
                    motion.unheard = not self._publish_stop(motion)
                elif motion.stopping and motion.leases.next_due() is None:
                    motion.stopping = False
                    # Under the lock, so that no command that has just passed is released.
                    self._graph.release(motion.topic)
                # A lease whose stop nobody hears ends for the guard, too, which then publishes its own.
                if not motion.unheard and now >= motion.written:
                    self._tell_guard(motion)
            due = [motion.next_due(now) for motion in self._motions.values()]
            # After the stops, since it may have to start a process.
            if self._guard is not None:
                self._guard.tick(stops=not any(motion.unheard for motion in self._motions.values()))
        for sample in stopped:
            self._operator.drove(sample)
        return min((at for at in due if at is not None), default=None)

    def report(self) -> dict[str, Any]:
        """The passed and the limited commands and the published stops, by name."""
        return {command.name: command.report() for command in self._commands.values()}

    def alarms(self) -> list[str]:
        """Why no motion may pass."""
        alarms = []
        if self.held():
            alarms.append("emergency stop: no motion until an operator releases it")
        if self.guarded() is False:
            alarms.append("the guard does not run yet: no motion until it does")
        return alarms

    def held(self) -> bool:
        """Whether an emergency stop holds."""
        return any(motion.leases.held for motion in self._motions.values())

    def guarded(self) -> bool | None:
        """Whether the guard would stop the robot; None if it needs none."""
        with self._lock:
            return None if self._guard is None else self._guard.ready()

    def _tell_guard(self, motion: Motion) -> bool:
        """Tell the guard the motion's lease and emergency stop, if they are others; whether that was
        possible."""
        known = (motion.leases.ends, motion.leases.held)
        if self._guard is None or known == motion.guarded:
            return True
        motion.guarded = known
        ends = motion.leases.ends
        until = None if ends is None else ends + STOP_AHEAD_MS / 1000
        return self._guard.tell(motion.topic, until, held=motion.leases.held)

    def _publish_stop(self, motion: Motion) -> bool:
        """Whether that was possible. One motion that fails must not keep the others from stopping."""
        try:
            published = self._graph.publish(motion.topic, motion.stop(self._clock.now_us()))
        except Exception:  # noqa: BLE001 - whatever a ROS library raises
            _log.exception("%s: the stop failed", motion.topic)
            return False
        motion.stops += published
        return published

    def _begin_stop(self, motion: Motion, now: float) -> list[Mapping[str, Value]]:
        """Note that a stop begins; the sample of it, if somebody drove before."""
        motion.stopping = True
        if self._guard is not None:
            motion.written = now + _WRITTEN_S
        command, last = motion.last, motion.leases.last
        what = f"command {command.name}" if command is not None else motion.topic
        _log.warning("%s: %s, stopping", what, motion.leases.why_stopped())
        return (
            [] if command is None or last is None else [command.sample(last, STOPPED, now, motion.picture_ms)]
        )

    def _unready(self) -> str | None:
        """Why no motion may pass yet."""
        if not self._operator.settings_known():
            return SETTINGS_UNKNOWN
        return NO_GUARD if self._guard is not None and not self._guard.ready() else None

    def _picture_ms(self, command: Command, now: float) -> float | None:
        """The age of the picture that a command names."""
        if self._sight is None or command.frame is None:
            return None
        return self._sight.age_ms(command.frame, now)

    def _on_connection(self, connected: bool) -> None:  # noqa: FBT001 - as the uplink calls it
        if connected:
            return
        with self._lock:
            for motion in self._motions.values():
                motion.leases.cut(self._clock.monotonic())
        self.tick()
        self._wake()

    def _on_message(self, message: MqttMessage) -> None:
        command = self._commands.get(message.topic)
        if command is None:
            self._refuse(message)
            return
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
        self, command: Named, offered: Command
    ) -> tuple[tuple[str, str] | None, Mapping[str, Value] | None]:
        """Publish the command if it may pass. Returns the reason if not, as a word and as a text, and the
        sample of a motion."""
        try:
            data = command.data(offered.message, self._clock.now_us())
        except MessageError as error:
            return ("malformed", str(error)), None
        motion, asked = command.motion, self._clock.monotonic()
        if motion is not None and self._sight is not None and offered.ends:
            # It passes by any picture, so it must move nothing, whatever it says.
            offered = replace(offered, message=motion.stop_message)
            data = motion.stop(self._clock.now_us())
        # Before the lock, so that no stop waits for the pictures.
        picture_ms = self._picture_ms(offered, asked)
        # All times under the lock, for which the command may have waited.
        with self._lock:
            now, now_us = self._clock.monotonic(), self._clock.now_us()
            if picture_ms is not None:
                picture_ms += (now - asked) * 1000
            offset = self._bridge.offset()
            uncertainty_us = None
            if offset is not None:
                now_us += round(offset.offset_ms * 1000)
                uncertainty_us = round(offset.uncertainty_ms * 1000)
            reason = self._unready() if motion is not None else None
            if reason is None:
                reason = command.leases.offer(
                    offered,
                    command.allowed,
                    now_us=now_us,
                    uncertainty_us=uncertainty_us,
                    now=now,
                    picture_ms=picture_ms,
                )
            if reason is None and motion is not None:
                motion.last, motion.picture_ms = command, picture_ms
                motion.stopping = motion.stopping and offered.ends
                # Before the robot moves.
                if not self._tell_guard(motion):
                    motion.leases.cut(now)
                    reason = NO_GUARD
            if reason is None and not self._graph.publish(command.config.topic, data):
                reason = NO_ROS
            command.passed += reason is None
            sample = None
            if motion is not None and (reason is None or now >= command.refused_due):
                command.refused_due = now + _REFUSED_S if reason is not None else command.refused_due
                sample = command.sample(offered, reason or ACCEPTED, now, picture_ms)
        if reason is None:
            return None, sample
        ago_s = (now_us - offered.sent_us) / 1e6
        by = f"to within {uncertainty_us / 1e6:.3f} s" if uncertainty_us is not None else "by its own clock"
        return (reason, f"{reason.replace('_', ' ')}, sent {ago_s:.3f} s ago, {by}"), sample
