"""The agent's node in a ROS 2 graph: one in a process, shared by all its users.

One thread owns the session, and with it every subscription and service. It looks at the graph several times a
second while a wanted topic is missing, else once a second: rclpy tells of a new topic in no other way. The
users of the node wait for none of this.

Humble's and Jazzy's rclpy leave out which publisher a message is from, so all publishers of one type of a
topic are one to the users of the node. Rolling's tells the publisher's GID.
"""

from __future__ import annotations

import logging
import threading
from typing import Any, Callable, Mapping, Sequence

from iort_agent.common.threads import Clock, Supervised, SystemClock
from iort_agent.errors import SourceError
from iort_agent.ros import OnBytes
from iort_agent.ros.qos import QosConfig
from iort_agent.ros.ros1_types import OnTrigger
from iort_agent.ros.ros2_session import Publisher, Session
from iort_agent.ros.ros2_topic import OnMessage, Topic
from iort_agent.ros.ros2_types import Types, rclpy
from iort_agent.ros.ros2_types import service as service_class
from iort_agent.ros.ros2_wait import RclpySession
from iort_contract.ros.definition import Definition

_log = logging.getLogger(__name__)

DEFAULT_NODE = "iort_agent"
_TRIGGER = "std_srvs/srv/Trigger"
_LOOK_S, _MISSING_S = 1.0, 0.2
# To ask what a topic's publishers offer takes a while; that of so many topics is asked for at a look.
_AT_A_LOOK = 10
_DEPTH = 10
_JOIN_S = 3.0
# The last messages may still be in memory that subscribers read, or have to be sent again.
_LAST_WRITE_S = 0.2

_lock = threading.Lock()
_shared: list[Node] = []


def shared(name: str = DEFAULT_NODE, clock: Clock | None = None) -> Node:
    """The process' node; each caller must `Node.close` it.

    Raises `SourceError` without rclpy, and for a second name.
    """
    with _lock:
        if not _shared:
            rclpy()
            _shared.append(Node(name, RclpySession, clock or SystemClock()))
        node = _shared[0]
        if node.name != name:
            raise SourceError(f"the agent is the ROS node {node.name} already, and cannot be {name} too")
        node.users += 1
        return node


class Node:
    """Use `shared`. Subscriptions and publishers may be requested before anybody else is in the graph."""

    ros = 2

    def __init__(
        self, name: str, join: Callable[[str], Session], clock: Clock, types: Types | None = None
    ) -> None:
        self.name = name
        self.users = 0
        self.failed: str | None = None
        self.ready = threading.Event()
        # The topics in the graph.
        self.topics: Sequence[str] = ()
        self._clock = clock
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._session = session = join(name)
        self.base = session.name.rpartition("/")[2]
        self.sim_time = session.sim_time
        self._types = types or Types()
        self._names: dict[str, str] = {}
        self._wanted: dict[str, Topic] = {}
        # How `subscribe` made an `OnMessage` of each handler.
        self._takers: dict[tuple[str, OnBytes], OnMessage] = {}
        self._advertised: dict[str, str] = {}
        self._publishers: dict[str, Publisher] = {}
        self._offered: dict[str, OnTrigger] = {}
        self._changed = True
        self._thread = Supervised("ros2 node", self._run)

    def start(self) -> None:
        """Begin; again has no effect."""
        with self._lock:
            if not self._thread.is_alive() and not self._stop.is_set():
                self._thread.start()

    def close(self) -> None:
        """Give up the node as one of its users; with the last user it leaves the graph."""
        with _lock:
            self.users -= 1
            if self.users:
                return
            if self in _shared:
                _shared.remove(self)
        self._stop.set()
        self._session.wake()
        self._thread.join(_JOIN_S)
        if self._publishers:
            threading.Event().wait(_LAST_WRITE_S)
        if not self._thread.is_alive():
            self._session.close()

    def waits(self) -> str | None:
        """Why a topic is not heard. ROS 2 has no master to wait for, and allows a name twice."""
        return next((topic.why for topic in [*self._wanted.values()] if topic.why is not None), None)

    def resolve(self, topic: str) -> str:
        """The topic's name in the graph, as the command line may remap it. Raises `SourceError` for a name
        that ROS 2 does not allow."""
        # A report comes after the node has left the graph, and can ask nobody any more.
        if topic not in self._names:
            try:
                self._names[topic] = self._session.resolve(topic)
            except Exception as error:
                raise SourceError(f"{topic} is no name of a topic in ROS 2: {error}") from error
        return self._names[topic]

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages, of any type, in the node's thread."""

        def take(header: Mapping[str, str], data: bytes, _source_ns: int, _received_ns: int) -> None:
            handler(header, data)

        self._takers[topic, handler] = take
        self.listen(topic, take)

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        """Stop receiving."""
        take = self._takers.pop((topic, handler), None)
        if take is not None:
            self.ignore(topic, take)

    def listen(
        self, topic: str, taker: OnMessage, qos: QosConfig | None = None, *, patient: bool = False
    ) -> None:
        """Receive a topic's messages as `subscribe`, each with the time at which it was published; with
        ``qos``, by that quality of service. For a ``patient`` taker they may come a moment later."""
        name = self.resolve(topic)
        with self._lock:
            if name not in self._wanted:
                self._wanted[name] = Topic(name, self._session, self._types, self._clock)
            wanted = self._wanted[name]
            wanted.qos = qos or wanted.qos
            wanted.takers = (*wanted.takers, taker)
            if patient:
                wanted.patient |= {taker}
        self._change()

    def ignore(self, topic: str, taker: OnMessage) -> None:
        """Stop what `listen` began."""
        with self._lock:
            wanted = self._wanted.get(self.resolve(topic))
            if wanted is not None:
                wanted.takers = tuple(one for one in wanted.takers if one != taker)
        self._change()

    def definition(self, kind: str) -> Definition:
        """The definition of an installed type. Raises `SourceError` if it is not installed, or cannot be
        read."""
        return self._types.definition(kind)

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of the topic, to which subscribers then connect: `publish` alone is too late.

        It keeps no message for subscribers that come later, because an old command must not run later.
        """
        self.definition(kind)
        # Another robot's message may come when the node has left the graph.
        if self._stop.is_set() or self.resolve(topic) in self._advertised:
            return
        with self._lock:
            self._advertised[self.resolve(topic)] = kind
        self._change()

    def offer(self, service: str, handler: OnTrigger) -> None:
        """Answer calls of a service of the type std_srvs/srv/Trigger, each in a thread of its own."""
        with self._lock:
            self._offered[service] = handler
        self._change()

    def release(self, topic: str) -> None:
        """Nothing to do: a joystick or a planner on board drives on by itself."""

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message's CDR bytes, with their encapsulation header, on an advertised topic; False if
        the node is not in the graph."""
        publisher = None if self._stop.is_set() else self._publishers.get(self.resolve(topic))
        if publisher is None:
            return False
        try:
            publisher.publish(data)
        except Exception:
            if not self._stop.is_set():
                raise
            return False  # shutting down
        return True

    def types(self) -> Mapping[str, Sequence[str]]:
        """The topics that somebody publishes or hears, and the types of each."""
        return self._session.topics()

    def connections(self, topic: str) -> int:
        """How many publishers a subscribed topic is connected to."""
        wanted = self._wanted.get(self.resolve(topic))
        return wanted.connections() if wanted is not None and not self._stop.is_set() else 0

    def listeners(self, topic: str) -> int:
        """How many subscribers an advertised topic is connected to."""
        publisher = self._publishers.get(self.resolve(topic))
        return publisher.subscribers() if publisher is not None and not self._stop.is_set() else 0

    def living(self, base: str) -> frozenset[str]:
        """What tells the nodes of this name, in our namespace, apart: an identifier of each in the graph. One
        that was killed stays there until the middleware misses it, beside the one that was started since."""
        return frozenset(self._session.nodes(self._session.name[: -len(self.base)] + base))

    def report(self, topic: str) -> dict[str, Any]:
        """What was lost of a topic before it came here, and the quality of service by which it is heard."""
        wanted = self._wanted.get(self.resolve(topic))
        return wanted.report() if wanted is not None else {}

    def _change(self) -> None:
        self._changed = True
        self._session.wake()

    # All below runs in the node's own thread.

    def _run(self) -> None:
        session, look_at = self._session, 0.0
        try:
            _log.info("ROS 2 node %s", session.name)
            while not self._stop.is_set():
                if self._changed or self._clock.monotonic() >= look_at:
                    self._changed = False
                    look_at = self._clock.monotonic() + (_LOOK_S if self._look() else _MISSING_S)
                    self.ready.set()
                session.wait(max(0.0, look_at - self._clock.monotonic()))
        except BaseException as error:
            if not self._stop.is_set():
                self.failed = f"the ROS node {session.name} has ended: {type(error).__name__}: {error}"
                raise

    def _look(self) -> bool:
        """Give the session what is wanted, as the graph is now. Whether every wanted topic was there."""
        session = self._session
        with self._lock:
            wanted, advertised = [*self._wanted.values()], dict(self._advertised)
            offered, self._offered = self._offered, {}
        for topic, kind in advertised.items():
            if topic not in self._publishers:
                message_class = self._types.found(kind).message_class
                self._publishers[topic] = session.advertise(topic, message_class, _DEPTH)
        for name, handler in offered.items():
            self._serve(name, handler)
        session.events()
        graph = session.topics()
        self.topics = tuple(graph)
        every = 1 + len(wanted) // _AT_A_LOOK
        for one in wanted:
            one.look(graph.get(one.name, ()), every)
        return all(one.heard() for one in wanted)

    def _serve(self, name: str, handler: OnTrigger) -> None:
        try:
            self._session.offer(name, service_class(_TRIGGER), handler)
        except Exception as error:  # noqa: BLE001 - rclpy's own, as for its name; all else must go on
            _log.error("the service %s is not offered: %s", name, error)
