"""The configuration's sections `downlink` and `share`.

downlink:
cmd:                                    # cmd/<namespace>/<robot>/<name>
drive:
topic: /drive
type: ackermann_msgs/AckermannDriveStamped
motion: {lease_s: 0.5, stop: {drive: {speed: 0.0}}}
fleet:                                  # fleet/<namespace>/+/<name>, of all other robots
pose: {topic: "/fleet/{robot}/pose", type: geometry_msgs/PoseStamped}
share:                                    # to fleet/<namespace>/<robot>/<name>
/pose: {name: pose, rate_hz: 5}
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Callable, Mapping

from iort_agent.schema import Rule, Where, flag, number, pairs, section, setting, text
from iort_agent.sources.ros1 import ros_name
from iort_contract.limits import ContractError
from iort_contract.messages.commands import FLEET_MAX_AGE_MS, MAX_LEASE_MS, MAX_VALID_MS
from iort_contract.topics import check_stream

ROBOT_IN_TOPIC = "{robot}"


def _ros_type(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z]\w*/[A-Za-z]\w*", value, re.ASCII):
        raise ContractError(f"ROS type {value!r}: allowed is package/Type, such as std_msgs/Float64")
    return value


def _fleet_topic(value: str) -> str:
    if value.count(ROBOT_IN_TOPIC) != 1:
        raise ContractError(f"{value!r}: allowed is a ROS topic with {ROBOT_IN_TOPIC} in it, once")
    ros_name(value.replace(ROBOT_IN_TOPIC, "robot"))
    return value


def _object(value: Any, where: Where) -> Any:
    if not isinstance(value, dict):
        raise where.error(value, "a mapping of the ROS message's fields")
    return value


def _by(check: Callable[[str], str], rule: Rule, what: str) -> Rule:
    def mapping(value: Any, where: Where) -> Any:
        found = pairs(rule, what=what)(value, where)
        for key, _ in found:
            text(check)(key, where)
        return found

    return mapping


@dataclass(frozen=True)
class MotionConfig:
    """A command that moves the robot. ``lease_s``: it goes on at most so long after it was sent; then,
    on a lost connection and at the agent's end, ``stop`` is published: the message's fields, of which
    those left out are zero."""

    stop: Mapping[str, Any] = setting(_object)
    lease_s: float = setting(number(0.05, MAX_LEASE_MS / 1000, unit="s"), 0.5)


@dataclass(frozen=True)
class CommandConfig:
    """A command's ROS topic. ``partial``: fields left out are zero, otherwise they are refused.
    ``max_age_s``: older ones are refused, whatever they allow themselves."""

    topic: str = setting(text(ros_name))
    type: str = setting(text(_ros_type))
    partial: bool = setting(flag(), default=False)
    max_age_s: float = setting(number(0.05, MAX_VALID_MS / 1000, unit="s"), 1.0)
    motion: MotionConfig | None = setting(section(MotionConfig), default=None)


@dataclass(frozen=True)
class FleetConfig:
    """Other robots' messages of one name: ``{robot}`` in the topic becomes theirs, - becomes _."""

    topic: str = setting(text(_fleet_topic))
    type: str = setting(text(_ros_type))
    max_age_s: float = setting(number(0.05, 60, unit="s"), FLEET_MAX_AGE_MS / 1000)


@dataclass(frozen=True)
class ShareConfig:
    """A ROS topic's newest message for other robots, at most so often."""

    name: str = setting(text(check_stream))
    rate_hz: float = setting(number(0.01, 20, unit="Hz"), 5.0)


@dataclass(frozen=True)
class DownlinkConfig:
    """What comes from the broker to ROS. ``clock_skew_s``: so far may an operator's clock be ahead."""

    cmd: tuple[tuple[str, CommandConfig], ...] = setting(
        _by(check_stream, section(CommandConfig), "a mapping of command to ROS topic and type"),
        (),
    )
    fleet: tuple[tuple[str, FleetConfig], ...] = setting(
        _by(check_stream, section(FleetConfig), "a mapping of name to ROS topic and type"), ()
    )
    clock_skew_s: float = setting(number(0, 60, unit="s"), 1.0)


def share_rule() -> Rule:
    """The rule for the configuration's section `share`."""
    shares = _by(ros_name, section(ShareConfig), "a mapping of ROS topic to name and rate")

    def rule(value: Any, where: Where) -> Any:
        found = shares(value, where)
        names = [settings.name for _, settings in found]
        for i, (topic, settings) in enumerate(found):
            if settings.name in names[:i]:
                raise where.child(topic).problem(f"another topic is shared as {settings.name} already")
        return found

    return rule
