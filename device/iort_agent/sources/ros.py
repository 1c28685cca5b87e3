"""What the sources of ROS 1 and ROS 2 share: topics by their names or by patterns, and their messages' way to
samples."""

from __future__ import annotations

import functools
import logging
import re
import threading
from abc import abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Protocol, Sequence

from iort_agent.common.schema import Place, choice, pairs, section, setting, text
from iort_agent.common.threads import Clock
from iort_agent.errors import SourceError
from iort_agent.sources import REFUSE, RING, UPLOAD, Emit, SourceConfig, intake
from iort_agent.sources.intake import Intake
from iort_agent.sources.repeats import Repeats
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.limits import ContractError
from iort_contract.topics import MAX_STREAM, check_stream, matches, stream_of

_log = logging.getLogger(__name__)

# The longest delay of the last message of a topic that falls silent.
_LOOK_S = 0.3
_TOPIC = re.compile(r"(/[A-Za-z]\w*)(/\w+)*", re.ASCII)
_PATTERN = re.compile(r"/[\w/]*\*[\w/*]*", re.ASCII)
_DIGIT_FIRST = re.compile(r"/\d", re.ASCII)
_NODE = re.compile(r"[A-Za-z]\w*", re.ASCII)
_MAX_TOPICS = 1000


def ros_name(value: str) -> str:
    """The full name of a topic. Raises `ContractError` for any other text."""
    if not _TOPIC.fullmatch(value):
        raise ContractError(f"ROS topic must be a full name such as /sensors/core, got {value!r}")
    return value


def node_name(value: str) -> str:
    """The name of a node, without its namespace. Raises `ContractError` for any other text."""
    if not _NODE.fullmatch(value):
        raise ContractError(f"ROS node must be a letter, then letters, digits and _, got {value!r}")
    return value


def ros2_name(value: str) -> str:
    """As `ros_name`, of a topic of ROS 2."""
    if _DIGIT_FIRST.search(ros_name(value)):
        raise ContractError(f"ROS 2 topic must have no part that begins with a digit, got {value!r}")
    return value


@dataclass(frozen=True)
class TopicConfig(intake.TopicConfig):
    """How a topic is recorded, with ``large: upload`` to send bytes (images, point clouds) as files;
    otherwise they are left out. A name with ``*``, which stands for any characters, is a pattern of topics.
    Without ``stream`` it is the topic's name: /sensors/imu becomes sensors-imu. With ``only: ring`` the topic
    is kept in the event recorder's ring, whole, and not recorded."""

    stream: str = setting(text(check_stream), "")
    large: str = setting(choice(REFUSE, UPLOAD), REFUSE)
    only: str | None = setting(choice(RING), None)


def topics_rule(
    kind: type[TopicConfig], named: Callable[[str], str] = ros_name
) -> Callable[[Any, Place], Any]:
    """The rule for a mapping of topics to their settings, of which each gets its stream. ``named`` checks the
    names that are no patterns."""
    mapping = pairs(section(kind), what="a mapping of ROS topic to its stream and time")

    def rule(value: Any, where: Place) -> Any:
        for name in value if isinstance(value, dict) else ():
            if not (isinstance(name, str) and _PATTERN.fullmatch(name)):
                text(named)(name, where)
        return tuple(
            (name, replace(topic, stream=topic.stream or ("" if "*" in name else stream_of(name))))
            for name, topic in mapping(value, where)
        )

    return rule


class RosConfig(SourceConfig):
    """A source of ROS topics, of ROS 1 or 2: ``ros``."""

    ros: int
    topics: Sequence[tuple[str, Any]]
    node: str

    def streams(self) -> Sequence[str]:
        """The streams of the topics; several topics may share one. A pattern's own are not known yet."""
        return sorted({topic.stream for _, topic in self.topics if topic.stream and not topic.only})

    def only_ring(self) -> Sequence[str]:
        """The streams of the topics that are not recorded."""
        return sorted({topic.stream for _, topic in self.topics if topic.stream and topic.only})

    def has_ring(self) -> bool:
        """Whether a topic is for the ring alone."""
        return any(topic.only for _, topic in self.topics)

    def uploads_large(self) -> bool:
        """Whether a topic sends bytes as files."""
        return any(topic.large == UPLOAD and not topic.only for _, topic in self.topics)

    def listed(self) -> str:
        """The topics in a few words."""
        return ", ".join(name for name, _ in self.topics)


class RosNode(Protocol):
    """What a source needs of a node."""

    failed: str | None
    sim_time: bool
    ready: threading.Event
    topics: Sequence[str]

    def resolve(self, topic: str) -> str: ...
    def connections(self, topic: str) -> int: ...
    def waits(self) -> str | None: ...
    def start(self) -> None: ...
    def close(self) -> None: ...


class RosSource:
    """Emits each message of the topics, in the threads that receive them."""

    def __init__(self, config: RosConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._intakes: dict[str, Intake] = {}
        self._node: Any = None
        self._seen: Sequence[str] = ()
        self._queue: Path | None = None
        self._taken: frozenset[str] = OWN_STREAMS
        # The streams that are not recorded; a pattern's come as its topics are found.
        self.only_ring = set(config.only_ring())
        self.ring_topics: set[str] = set()
        # Whether somebody takes whole messages, whatever is selected of them.
        self.whole = False

    def remember(self, queue: Path | None, taken: Sequence[str]) -> None:
        """Keep the memory of latched messages beside the queue; ``taken`` are other sources' streams."""
        self._queue, self._taken = queue, OWN_STREAMS | frozenset(taken)

    @abstractmethod
    def join(self) -> Any:
        """The process' node."""

    @abstractmethod
    def listen(self, topic: str, settings: Any, intake: Intake) -> None:
        """Receive a topic's messages."""

    @abstractmethod
    def ignore(self, topic: str, intake: Intake) -> None:
        """Stop receiving them."""

    def counts(self, topic: str) -> Mapping[str, Any]:  # noqa: ARG002 - ROS 1 has none
        """What the graph tells of a topic, for the report."""
        return {}

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Subscribe until ``stop`` is set. Raises `SourceError` without ROS, or if the node ends."""
        node: RosNode = self.join()
        self._node, repeats = node, Repeats(self._queue, self._clock)
        try:
            for name, settings in self._config.topics:
                if "*" not in name:
                    self._add(name, settings, emit, repeats)
            node.start()
            while True:
                if node.failed:
                    raise SourceError(node.failed)
                for topic, settings in self._new():
                    self._add(topic, settings, emit, repeats)
                for topic, intake in self._intakes.items():
                    intake.sim_time = node.sim_time
                    if node.ready.is_set():
                        intake.look(functools.partial(node.connections, topic))
                    else:
                        intake.take_received()
                repeats.tick()
                if self._clock.wait(stop, _LOOK_S):
                    return
        finally:
            for topic, intake in self._intakes.items():
                self.ignore(topic, intake)
                intake.take_received()
            node.close()
            repeats.write()

    def report(self) -> dict[str, Any]:
        """The counts of the messages, by topic, and what the node waits for, if it does."""
        waits = self._node.waits() if self._node is not None else None
        topics = {
            topic: {**intake.report(), **self.counts(topic)} for topic, intake in self._intakes.copy().items()
        }
        return {**topics, "waits": waits} if waits is not None else topics

    def _new(self) -> Iterator[tuple[str, Any]]:
        """The topics in the graph that fit a pattern, since the last call."""
        patterns = [(name, settings) for name, settings in self._config.topics if "*" in name]
        topics, seen, self._seen = self._node.topics, self._seen, self._node.topics
        if not patterns or topics is seen:
            return
        known = {self._node.resolve(topic) for topic in self._intakes}
        for topic in topics:
            settings = next((one for pattern, one in patterns if matches(pattern, topic)), None)
            if settings is None or topic in known or len(self._intakes) >= _MAX_TOPICS:
                continue
            stream = settings.stream or stream_of(topic)
            if not settings.stream and stream in self._taken:
                stream = f"topic-{stream}"[:MAX_STREAM]
            _log.info(
                "topic %s: %s as the stream %s", topic, "in the ring" if settings.only else "recorded", stream
            )
            yield topic, replace(settings, stream=stream)

    def _add(self, topic: str, settings: Any, emit: Emit, repeats: Repeats) -> None:
        name = self._node.resolve(topic)
        latched = repeats.of(settings.stream, name)
        if settings.only:
            # Nobody reads the fields.
            settings = replace(settings, fields=None, large=REFUSE)
            self.only_ring.add(settings.stream)
            self.ring_topics.add(topic)
        intake = Intake(
            name,
            settings,
            emit=emit,
            clock=self._clock,
            large=settings.large,
            latched=latched,
            whole=self.whole,
        )
        self._intakes[topic] = intake
        self.listen(topic, settings, intake)
