"""A node in a ROS 1 graph: any topic, of any message type, whose class need not be installed.

The publisher sends its message's definition when it connects. ROS_MASTER_URI names the graph.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any, Iterator

from iort_agent.common.schema import setting, text
from iort_agent.common.threads import Clock
from iort_agent.ros import ros1_master
from iort_agent.ros.ros1_node import DEFAULT_NODE, shared
from iort_agent.sources import FAIL, OK, Finding
from iort_agent.sources.intake import Intake
from iort_agent.sources.ros import RosConfig, RosSource, TopicConfig, node_name, topics_rule


@dataclass(frozen=True)
class Ros1Config(RosConfig):
    """Topics of the ROS 1 graph whose master the environment's ROS_MASTER_URI names."""

    ros = 1

    topics: tuple[tuple[str, TopicConfig], ...] = setting(topics_rule(TopicConfig))
    node: str = setting(text(node_name), DEFAULT_NODE)

    def describe(self) -> str:
        """The source in a few words."""
        return f"ROS 1 topics {self.listed()}"

    def build(self, clock: Clock) -> Ros1Source:
        """Make the source; rospy is looked for when it runs."""
        return Ros1Source(self, clock)

    def check(self, title: str) -> Iterator[Finding]:
        """Whether rospy and the master are there."""
        if importlib.util.find_spec("rospy") is None:
            todo = "source /opt/ros/noetic/setup.bash, in an environment made with --system-site-packages"
            yield Finding(title, FAIL, "Python finds no rospy", todo)
        uri = ros1_master.uri()
        try:
            pid = ros1_master.Master(uri, "/iort_check").ask("getPid")
        except ros1_master.ERRORS as error:
            todo = "start `roscore`, or set ROS_MASTER_URI (in the unit: /etc/iort/environment)"
            yield Finding(title, FAIL, f"no ROS master at {uri}: {error}", todo)
        else:
            yield Finding(title, OK, f"ROS master at {uri}, process {pid}")


class Ros1Source(RosSource):
    """The source of ROS 1."""

    def join(self) -> Any:
        return shared(self._config.node, self._clock)

    def listen(self, topic: str, settings: TopicConfig, intake: Intake) -> None:  # noqa: ARG002 - no QoS
        self._node.subscribe(topic, intake.receive)

    def ignore(self, topic: str, intake: Intake) -> None:
        self._node.unsubscribe(topic, intake.receive)
