"""A node in a ROS 1 graph: any topic, of any message type, whose class need not be installed.

The publisher sends its message's definition when it connects. ROS_MASTER_URI names the graph.
"""

from __future__ import annotations

import functools
import importlib.util
import re
import threading
from dataclasses import dataclass
from typing import Any, Iterator, Sequence

from iort_agent.common.schema import Place, choice, pairs, section, setting, text
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.ros import ros1_master
from iort_agent.ros.ros1_node import DEFAULT_NODE, Node, shared
from iort_agent.sources import FAIL, OK, REFUSE, UPLOAD, Emit, Finding, SourceConfig, intake
from iort_agent.sources.intake import Intake
from iort_contract.limits import ContractError

# The longest delay of the last message of a topic that falls silent.
_LOOK_S = 0.3
_TOPIC = re.compile(r"(/[A-Za-z]\w*)(/\w+)*", re.ASCII)
_NODE = re.compile(r"[A-Za-z]\w*", re.ASCII)


def ros_name(value: str) -> str:
    """The full name of a topic. Raises `ContractError` for any other text."""
    if not _TOPIC.fullmatch(value):
        raise ContractError(f"ROS topic must be a full name such as /sensors/core, got {value!r}")
    return value


def _node_name(value: str) -> str:
    if not _NODE.fullmatch(value):
        raise ContractError(f"ROS node must be a letter, then letters, digits and _, got {value!r}")
    return value


@dataclass(frozen=True)
class TopicConfig(intake.TopicConfig):
    """How a topic is recorded, with ``large: upload`` to send bytes (images, point clouds) as files;
    otherwise they are left out."""

    large: str = setting(choice(REFUSE, UPLOAD), REFUSE)


def _topics(value: Any, where: Place) -> Any:
    rule = pairs(section(TopicConfig), what="a mapping of ROS topic to its stream and time")
    for topic in value if isinstance(value, dict) else ():
        text(ros_name)(topic, where)
    return rule(value, where)


@dataclass(frozen=True)
class Ros1Config(SourceConfig):
    """Topics of the ROS 1 graph whose master the environment's ROS_MASTER_URI names."""

    topics: tuple[tuple[str, TopicConfig], ...] = setting(_topics)
    node: str = setting(text(_node_name), DEFAULT_NODE)

    def streams(self) -> Sequence[str]:
        """The streams of the topics; several topics may share one."""
        return sorted({topic.stream for _, topic in self.topics})

    def describe(self) -> str:
        """The source in a few words."""
        return f"ROS 1 topics {', '.join(topic for topic, _ in self.topics)}"

    def build(self, clock: Clock) -> Ros1Source:
        """Make the source; rospy is looked for when it runs."""
        return Ros1Source(self, clock)

    def uploads_large(self) -> bool:
        """Whether a topic sends bytes as files."""
        return any(topic.large == UPLOAD for _, topic in self.topics)

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


class Ros1Source:
    """Emits each message of the topics, in the threads that receive them."""

    def __init__(self, config: Ros1Config, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._intakes: dict[str, Intake] = {}
        self._node: Node | None = None

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Subscribe until ``stop`` is set. Raises `SourceError` without rospy, or if the node ends."""
        node = self._node = shared(self._config.node, self._clock)
        try:
            for topic, settings in self._config.topics:
                intake = Intake(
                    node.resolve(topic), settings, emit=emit, clock=self._clock, large=settings.large
                )
                self._intakes[topic] = intake
                node.subscribe(topic, intake.receive)
            node.start()
            while not self._clock.wait(stop, _LOOK_S):
                if node.failed:
                    raise SourceError(node.failed)
                for topic, intake in self._intakes.items():
                    intake.sim_time = node.sim_time
                    if node.ready.is_set():
                        intake.look(functools.partial(node.connections, topic))
                    else:
                        intake.take_received()
        finally:
            for topic, intake in self._intakes.items():
                node.unsubscribe(topic, intake.receive)
                intake.take_received()
            node.close()

    def report(self) -> dict[str, Any]:
        """The counts of the messages, by topic, and what the node waits for, if it does."""
        waits = self._node.waits() if self._node is not None else None
        topics = {topic: intake.report() for topic, intake in self._intakes.copy().items()}
        return {**topics, "waits": waits} if waits is not None else topics
