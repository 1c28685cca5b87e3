"""The agent's node in a ROS 2 graph: one in a process, shared by all its users.

One thread owns the wait set, and with it every subscription, service and event. The users of the node wait
for nothing: they say what they want, and the thread makes it so when the graph allows.
"""

from __future__ import annotations

import threading
from typing import Any, Callable

from iort_agent.common.threads import Clock, Supervised, SystemClock
from iort_agent.errors import SourceError
from iort_agent.ros import OnBytes
from iort_agent.ros.ros1_types import OnTrigger
from iort_agent.ros.ros2_types import rclpy
from iort_contract.ros.definition import Definition

DEFAULT_NODE = "iort_agent"

_lock = threading.Lock()
_shared: list[Node] = []


def shared(name: str = DEFAULT_NODE, clock: Clock | None = None) -> Node:
    """The process' node; each caller must `Node.close` it.

    Raises `SourceError` without rclpy, and for a second name.
    """
    with _lock:
        if not _shared:
            _shared.append(Node(name, rclpy(), clock or SystemClock()))
        node = _shared[0]
        if node.name != name:
            raise SourceError(f"the agent is the ROS node {node.name} already, and cannot be {name} too")
        node.users += 1
        return node


class Node:
    """Use `shared`. Subscriptions and publishers may be requested before anybody else is in the graph."""

    ros = 2

    def __init__(self, name: str, join: Callable[[str], Any], clock: Clock) -> None:
        self.name = self.base = name
        self._join = join
        self.users = 0
        self.failed: str | None = None
        self.sim_time = False
        self.ready = threading.Event()
        self._clock = clock
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._handlers: dict[str, list[OnBytes]] = {}
        self._wanted: dict[str, str] = {}
        self._offered: dict[str, OnTrigger] = {}
        self._publishers: dict[str, Any] = {}
        self._thread = Supervised("ros2 node", self._run)

    def start(self) -> None:
        """Join the graph; again has no effect."""
        with self._lock:
            if not self._thread.is_alive() and not self._stop.is_set():
                self._thread.start()

    def close(self) -> None:
        """Give up the node as one of its users; with the last user it leaves the graph."""
        with _lock:
            self.users -= 1
            if self.users:
                return
            _shared.remove(self)
        self._stop.set()
        self._thread.join(3.0)

    def waits(self) -> str | None:
        """Why the graph cannot be joined. ROS 2 has no master to wait for, and allows a name twice."""
        return None

    def resolve(self, topic: str) -> str:
        """The topic's name in the graph, as the command line may remap it."""
        return topic

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages, of any type, in the node's thread."""
        with self._lock:
            self._handlers.setdefault(self.resolve(topic), []).append(handler)

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        """Stop receiving."""
        with self._lock:
            handlers = self._handlers.get(self.resolve(topic), [])
            if handler in handlers:
                handlers.remove(handler)

    def definition(self, kind: str) -> Definition:
        """The definition of an installed type. Raises `SourceError` if it is not installed."""
        raise SourceError(f"the ROS message type {kind} is not installed")

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of the topic, reliable and volatile: an old command must not run later.
        Raises as `definition`."""
        self.definition(kind)
        with self._lock:
            self._wanted.setdefault(self.resolve(topic), kind)

    def offer(self, service: str, handler: OnTrigger) -> None:
        """Answer calls of a service of the type std_srvs/srv/Trigger, each in a thread of its own."""
        with self._lock:
            self._offered[self.resolve(service)] = handler

    def release(self, topic: str) -> None:
        """Nothing to do: a joystick or a planner on board drives on by itself."""

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message's CDR bytes, with their encapsulation header, on an advertised topic; False if
        the node is not in the graph."""
        publisher = self._publishers.get(self.resolve(topic))
        if publisher is None:
            return False
        publisher.publish(data)
        return True

    def connections(self, topic: str) -> int:
        """How many publishers a subscribed topic is connected to."""
        return len(self._handlers.get(self.resolve(topic), ())) * 0

    def listeners(self, topic: str) -> int:
        """How many subscribers an advertised topic is connected to."""
        return len(self._wanted.get(self.resolve(topic), "")) * 0

    def living(self, base: str) -> frozenset[str]:  # noqa: ARG002 - as ROS 1's node
        """What tells the nodes of this name, in our namespace, apart: an identifier of each in the graph. One
        that was killed stays there until the middleware misses it, beside the one that was started since."""
        return frozenset()

    # All below runs in the node's own thread.

    def _run(self) -> None:
        try:
            self._join(self.name)
            self.ready.set()
            self._stop.wait()
        except BaseException as error:
            if not self._stop.is_set():
                self.failed = f"the ROS node {self.name} has ended: {type(error).__name__}: {error}"
                raise
