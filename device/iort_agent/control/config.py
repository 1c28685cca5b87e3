"""The configuration's sections `downlink` and `share`.

downlink:
  cmd:                                    # cmd/<namespace>/<robot>/<name>
    drive:
      topic: /drive
      type: ackermann_msgs/AckermannDriveStamped    # ROS 2: ackermann_msgs/msg/AckermannDriveStamped
      motion: {lease_s: 0.5, stop: {drive: {speed: 0.0}}}
  drive: {command: drive}                 # what a stick on the page or `iort drive` drives, and its limits
  ask:                                    # the service /iort/ask/calibration, and topics of that name
    calibration: {}
  fleet:                                  # fleet/<namespace>/+/<name>, of all other robots
    pose: {topic: "/fleet/{robot}/pose", type: geometry_msgs/PoseStamped}
share:                                    # to fleet/<namespace>/<robot>/<name>
  /pose: {name: pose, rate_hz: 5}
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterable, Mapping, NamedTuple

from iort_agent.common.schema import (
    FILE,
    Place,
    Rule,
    allowed,
    flag,
    number,
    pairs,
    section,
    setting,
    text,
)
from iort_agent.errors import AskError
from iort_agent.sources.ros import RosConfig, ros_name
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.commands import (
    FLEET_MAX_AGE_MS,
    MAX_LEASE_MS,
    MAX_VALID_MS,
    DriveLimits,
    check_limits,
    check_path,
)
from iort_contract.messages.questions import INVALID, MAX_ASK_MS
from iort_contract.messages.shadow import MOTION_STOPPED, SETTINGS
from iort_contract.ros.definition import is_ros2
from iort_contract.topics import check_stream

ROBOT_IN_TOPIC = "{robot}"
_STREAM = text(check_stream)
_COMMANDS = "a mapping of command to ROS topic and type"
_FLEET = "a mapping of name to ROS topic and type"


def _ros_type(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z]\w*/(msg/)?[A-Za-z]\w*", value, re.ASCII):
        raise ContractError(
            "ROS type must be package/Type, such as std_msgs/Float64, or package/msg/Type for ROS 2, "
            f"got {value!r}"
        )
    return value


def _fleet_topic(value: str) -> str:
    if value.count(ROBOT_IN_TOPIC) != 1:
        raise ContractError(f"must be a ROS topic with one {ROBOT_IN_TOPIC} in it, got {value!r}")
    ros_name(value.replace(ROBOT_IN_TOPIC, "robot"))
    return value


def _question(value: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", value):
        raise ContractError(f"question must be a name such as calibration, got {value!r}")
    return value


def _object(value: Any, place: Place) -> Any:
    if not isinstance(value, dict):
        raise place.error(value, "a mapping of the ROS message's fields")
    return value


class RosGraph(NamedTuple):
    """Of which ROS the graph is, 1 or 2, and the name of the agent's node in it, if a source says it."""

    version: int
    node: str | None


@dataclass(frozen=True)
class MotionConfig:
    """A command that moves the robot. It holds for at most ``lease_s`` after it was sent. Then, and when the
    connection is lost or the agent ends, ``stop`` is published; its missing fields are zero."""

    stop: Mapping[str, Any] = setting(_object)
    lease_s: float = setting(number(0.05, MAX_LEASE_MS / 1000, unit="s"), 0.5)


@dataclass(frozen=True)
class CommandConfig:
    """A command's ROS topic; ``type`` is package/Type, and package/msg/Type in ROS 2. With ``partial``,
    missing fields are zero; otherwise such a command is rejected. A command older than ``max_age_s`` is
    rejected, even if it allows a longer time."""

    topic: str = setting(text(ros_name))
    type: str = setting(text(_ros_type))
    partial: bool = setting(flag(), default=False)
    max_age_s: float = setting(number(0.05, MAX_VALID_MS / 1000, unit="s"), 1.0)
    motion: MotionConfig | None = setting(section(MotionConfig), default=None)


def _path(value: str) -> str:
    return check_path(value, "field")


@dataclass(frozen=True)
class DriveConfig:
    """The motion command that an operator's stick drives. ``speed`` and ``steering`` are
    fields of its ROS message. Both are limited in every command of this name, to either side."""

    command: str = setting(text(check_stream), "drive")
    speed: str = setting(text(_path), "drive.speed")
    steering: str = setting(text(_path), "drive.steering_angle")
    max_speed_mps: float = setting(number(0.01, 100, unit="m/s"), 2.0)
    max_steering_rad: float = setting(number(0.01, 10, unit="rad"), 0.4)


@dataclass(frozen=True)
class FleetConfig:
    """The ROS topic for other robots' messages of one name. ``{robot}`` in it becomes the robot's name, with
    _ for -."""

    topic: str = setting(text(_fleet_topic))
    type: str = setting(text(_ros_type))
    max_age_s: float = setting(number(0.05, 60, unit="s"), FLEET_MAX_AGE_MS / 1000)


@dataclass(frozen=True)
class AskConfig:
    """A question to the cloud that ROS nodes may ask. The service waits for an answer for ``timeout_s``. It
    asks with the ``body``, or with the object in the JSON file ``body_file``, which is read for each call."""

    timeout_s: float = setting(number(0.1, MAX_ASK_MS / 1000, unit="s"), 15.0)
    body: Mapping[str, Any] | None = setting(_object, default=None)
    body_file: Path | None = setting(FILE, default=None)

    def question(self) -> Mapping[str, Any]:
        """The body of a question without one of its own. Raises `AskError`."""
        if self.body_file is None:
            return self.body or {}
        try:
            return json_object(self.body_file.read_bytes(), str(self.body_file))
        except (OSError, ContractError) as error:
            raise AskError(INVALID, str(error)) from error


@dataclass(frozen=True)
class ShareConfig:
    """The name under which a ROS topic's newest message is sent to other robots, and the highest rate."""

    name: str = setting(text(check_stream))
    rate_hz: float = setting(number(0.01, 20, unit="Hz"), 5.0)


@dataclass(frozen=True)
class MotionState:
    """Motion by commands. If it is ``stopped``, the robot is in an emergency stop that no operator releases,
    only this file."""

    stopped: bool = setting(allowed(SETTINGS[MOTION_STOPPED]), default=False)


@dataclass(frozen=True)
class DownlinkConfig:
    """The ROS topics of received messages. An operator's clock may be ahead by ``clock_skew_s``."""

    cmd: tuple[tuple[str, CommandConfig], ...] = setting(
        pairs(section(CommandConfig), what=_COMMANDS, key=_STREAM), ()
    )
    drive: DriveConfig | None = setting(section(DriveConfig), default=None)
    fleet: tuple[tuple[str, FleetConfig], ...] = setting(
        pairs(section(FleetConfig), what=_FLEET, key=_STREAM), ()
    )
    ask: tuple[tuple[str, AskConfig], ...] = setting(
        pairs(section(AskConfig), what="a mapping of question to its settings", key=text(_question)), ()
    )
    clock_skew_s: float = setting(number(0, 60, unit="s"), 1.0)

    def moves(self) -> bool:
        """Whether a command moves the robot."""
        return bool(self.motions())

    def motions(self) -> dict[str, dict[str, Any]]:
        """The ROS topics that move the robot: the type, and the message that stops it."""
        return {
            command.topic: {"type": command.type, "stop": command.motion.stop}
            for _, command in self.cmd
            if command.motion is not None
        }

    def graph(self, sources: Iterable[object]) -> RosGraph:
        """The graph that everything here and in `share` is for: the one of the sources. The types decide if
        these are of both kinds, or of none. Raises `ContractError` for a type of the other ROS."""
        nodes = {one.ros: one.node for one in sources if isinstance(one, RosConfig)}
        types = {
            f"{section}.{name}.type": settings.type
            for section, entries in (("cmd", self.cmd), ("fleet", self.fleet))
            for name, settings in entries
        }
        versions = (
            set(nodes) if len(nodes) == 1 else {1 + is_ros2(kind) for kind in types.values()} or set(nodes)
        )
        # Without any of them, the ROS that was sourced.
        version = max(versions or {2 if os.environ.get("ROS_VERSION") == "2" else 1})
        for name, command in self.cmd:
            if version == 2 and re.search(r"/\d", command.topic):
                raise ContractError(
                    f"cmd.{name}.topic must have no part that begins with a digit, got {command.topic}"
                )
        for key, kind in types.items():
            if is_ros2(kind) != (version == 2):
                form = kind.replace("/", "/msg/") if version == 2 else kind.replace("/msg/", "/")
                raise ContractError(f"{key} must be {form}, as the graph is of ROS {version}, got {kind}")
        return RosGraph(version, nodes.get(version))

    def check_topics(self) -> None:
        """Raise `ContractError` for a command without motion on a topic that moves the robot, since neither a
        lease nor the emergency stop would end what it began, and for two stops of one topic."""
        moved = {
            command.topic: (name, command)
            for name, command in reversed(self.cmd)
            if command.motion is not None
        }
        for name, command in self.cmd:
            first, other = moved.get(command.topic, (name, command))
            if other.motion is None:
                continue
            topic = command.topic
            if command.motion is None:
                raise ContractError(
                    f"cmd.{name} must have motion, as cmd.{first} has: {topic} moves the robot"
                )
            if command.type != other.type or command.motion.stop != other.motion.stop:
                raise ContractError(
                    f"cmd.{name} must have the type and motion.stop of cmd.{first}: both are for {topic}"
                )

    def drive_limits(self) -> DriveLimits | None:
        """What a stick drives; None if nothing. Raises `ContractError` if the command is no motion."""
        drive = self.drive
        if drive is None:
            return None
        command = dict(self.cmd).get(drive.command)
        if command is None or command.motion is None:
            raise ContractError(f"command must be one of downlink.cmd with motion, got {drive.command}")
        return check_limits(
            DriveLimits(
                drive.command,
                drive.speed,
                drive.steering,
                drive.max_speed_mps,
                drive.max_steering_rad,
                round(command.motion.lease_s * 1000),
            )
        )


def share_rule() -> Rule:
    """The rule for the configuration's section `share`."""
    shares = pairs(section(ShareConfig), what="a mapping of ROS topic to name and rate", key=text(ros_name))

    def rule(value: Any, place: Place) -> Any:
        topics = shares(value, place)
        names = [settings.name for _, settings in topics]
        for i, (topic, settings) in enumerate(topics):
            if settings.name in names[:i]:
                raise place.child(topic).problem(f"another topic is shared as {settings.name} already")
        return topics

    return rule
