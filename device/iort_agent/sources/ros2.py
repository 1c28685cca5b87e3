"""A node in a ROS 2 graph: any topic, of any message type that is installed, by the robot's own rclpy.

Messages are recorded in the bytes in which they were published. The environment's ROS_DOMAIN_ID and
RMW_IMPLEMENTATION are rclpy's affair.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Mapping

from iort_agent.common.schema import choice, section, setting, text
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.ros.qos import QosConfig
from iort_agent.ros.ros2_node import DEFAULT_NODE, shared
from iort_agent.ros.ros2_types import rclpy
from iort_agent.sources import FAIL, OK, WARN, Finding, ros
from iort_agent.sources.intake import ARRIVAL, HEADER, SOURCE, Intake
from iort_agent.sources.ros import RosConfig, RosSource, node_name, ros2_name, topics_rule

# What chooses the part of the network in which robots find each other: until Humble, and since Iron.
# With any of these, Fast DDS need not share memory.
_TRANSPORTS = (
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
)
_RANGES = ("ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE")


@dataclass(frozen=True)
class TopicConfig(ros.TopicConfig):
    """How a topic is recorded, as of ROS 1. The ``time`` may also be ``source``, at which the middleware
    published the message, by the publisher's clock. ``qos`` is chosen by what the publishers offer, unless
    it is given here."""

    time: str = setting(choice(HEADER, ARRIVAL, SOURCE))
    qos: QosConfig = setting(section(QosConfig), QosConfig())


@dataclass(frozen=True)
class Ros2Config(RosConfig):
    """Topics of the ROS 2 graph that the environment's ROS_DOMAIN_ID names. A name with ``*``, which stands
    for any characters, is a pattern of topics."""

    ros = 2

    topics: tuple[tuple[str, TopicConfig], ...] = setting(topics_rule(TopicConfig, ros2_name))
    node: str = setting(text(node_name), DEFAULT_NODE)

    def describe(self) -> str:
        """The source in a few words."""
        return f"ROS 2 topics {self.listed()}"

    def build(self, clock: Clock) -> Ros2Source:
        """Make the source; rclpy is looked for when it runs."""
        return Ros2Source(self, clock)

    def check(self, title: str) -> Iterator[Finding]:
        """Whether rclpy is there, and which graph it would join."""
        python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
        try:
            name = middleware()
        except SourceError as error:
            todo = (
                "source /opt/ros/<distribution>/setup.bash, in an environment of that distribution's Python"
            )
            yield Finding(title, FAIL, f"{python} finds no rclpy: {error}", todo)
            return
        except Exception as error:  # noqa: BLE001 - a middleware that is not installed, for example
            yield Finding(title, FAIL, f"rclpy: {error}", "see RMW_IMPLEMENTATION")
            return
        distribution = os.environ.get("ROS_DISTRO", "of no name")
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        ranges = [f"{name}={os.environ[name]}" for name in _RANGES if os.environ.get(name)]
        found = [f"ROS 2 {distribution}", python, name, f"domain {domain}", *ranges]
        yield Finding(title, OK, ", ".join(found))
        if name.startswith("rmw_fastrtps") and not any(map(os.environ.get, _TRANSPORTS)) and _others():
            todo = "run the agent as that user, or (since Jazzy) with FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
            why = "Fast DDS shares memory within one user alone, and another user's nodes are here"
            yield Finding(title, WARN, f"{why}: their topics may be listed and bring no message", todo)


def middleware() -> str:
    """The name of the middleware that the agent would use. Raises `SourceError` without rclpy, and rclpy's
    errors."""
    return str(rclpy().get_rmw_implementation_identifier())


def _others(shared_memory: Path = Path("/dev/shm")) -> bool:  # noqa: S108 - Linux' name for it
    """Whether another user's nodes have memory of Fast DDS."""
    for file in shared_memory.glob("fastrtps_port*"):
        # A node may end meanwhile.
        with suppress(FileNotFoundError):
            if file.stat().st_uid != os.getuid():
                return True
    return False


class Ros2Source(RosSource):
    """The source of ROS 2."""

    def join(self) -> Any:
        return shared(self._config.node, self._clock)

    def listen(self, topic: str, settings: TopicConfig, intake: Intake) -> None:
        # Nobody looks at the ring at once.
        self._node.listen(topic, intake.receive, settings.qos, patient=bool(settings.only))

    def ignore(self, topic: str, intake: Intake) -> None:
        self._node.ignore(topic, intake.receive)

    def counts(self, topic: str) -> Mapping[str, Any]:
        counts: Mapping[str, Any] = self._node.report(topic)
        return counts
