"""The agent's node in a ROS 1 graph: one in a process, as rospy requires, shared by all its users.

rospy registers with the master only once, so a node hears nothing after the master's restart, and connects to
no publisher that started meanwhile. The node's own thread asks the master every few seconds what it knows,
and registers again what it has forgotten, without dropping the connections that still stand. The thread also
waits for a master that is not there yet, and for another node of the same name to go: a master ends the older
one of two. The users of the node wait for none of this.
"""

from __future__ import annotations

import functools
import importlib
import logging
import os
import random
import struct
import sys
import threading
import xmlrpc.client
from typing import Any, Mapping, Sequence

from iort_agent.common.threads import Clock, Supervised, SystemClock
from iort_agent.errors import SourceError
from iort_agent.ros import OnBytes, ros1_master
from iort_agent.ros.ros1_types import Installed, OnTrigger, installed, rospy, trigger
from iort_contract.limits import MessageError
from iort_contract.ros.definition import Definition, parse

_log = logging.getLogger(__name__)

DEFAULT_NODE = "iort_agent"
_ANY_TYPE = "*"
_POLL_S = 4.0
_WAIT_S = 1.0
# Two nodes that take the name from each other must not try again at the same moment, nor often.
_MAX_RETREAT_S = 60.0
# rospy hands the last messages to its own threads, and does not tell when they are written.
_LAST_WRITE_S = 0.2
_JOIN_S = 3.0
_QUEUE = 10
# rospy logs a traceback for every publisher that goes; this module logs what matters.
_LOGGERS = {
    "rospy": logging.CRITICAL,
    "rosout": logging.ERROR,
    "topicmanager": logging.ERROR,
    "xmlrpc": logging.ERROR,
}

_lock = threading.Lock()
_shared: list[Node] = []


def shared(name: str = DEFAULT_NODE, clock: Clock | None = None) -> Node:
    """The process' node; each caller must `Node.close` it.

    Raises `SourceError` without rospy, and for a second name, because a process is one node.
    """
    with _lock:
        if not _shared:
            _shared.append(Node(name, rospy(), clock or SystemClock()))
        node = _shared[0]
        if node.name != name:
            raise SourceError(f"the agent is the ROS node {node.name} already, and cannot be {name} too")
        node.users += 1
        return node


class Node:
    """Use `shared`. Subscriptions and publishers may be requested before there is a master."""

    ros = 1

    def __init__(self, name: str, rospy: Any, clock: Clock) -> None:
        self.name = name
        self.users = 0
        self.failed: str | None = None
        self.sim_time = False
        self.ready = threading.Event()
        # The topics that have publishers, by the last poll.
        self.topics: Sequence[str] = ()
        self._waits: str | None = None
        self._rospy = rospy
        self._clock = clock
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._handlers: dict[str, list[OnBytes]] = {}
        self._subscribers: dict[str, Any] = {}
        self._wanted: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self._offered: dict[str, OnTrigger] = {}
        self._services: dict[str, Any] = {}
        self._types: dict[str, tuple[Installed, Definition]] = {}
        self._absent = False
        # Registered again since the last poll that came to its end.
        self._restored: list[str] = []
        self._displaced = False
        self._losses = 0
        # The address of another node of our name.
        self._holder: str | None = None
        # The command line's remappings, as every ROS node reads them; `base` is the name without namespace.
        names = importlib.import_module("rosgraph.names")
        mappings = names.load_mappings(sys.argv)
        self.base: str = mappings.get("__name", name)
        self._me: str = names.ns_join(names.get_ros_namespace(), self.base)
        self._remapped: dict[str, str] = {
            names.resolve_name(topic, self._me): names.resolve_name(other, self._me)
            for topic, other in mappings.items()
            if not topic.startswith("__")
        }
        self._uri: str = importlib.import_module("rosgraph").get_master_uri()
        try:
            self._master = ros1_master.Master(self._uri, self._me)
        except OSError as error:
            raise SourceError(f"ROS_MASTER_URI is {self._uri!r}: {error}") from error
        self._thread = Supervised("ros1 node", self._run)

    def start(self) -> None:
        """Join the graph as soon as it is there; again has no effect."""
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
        self._wake.set()
        if self._publishers:
            threading.Event().wait(_LAST_WRITE_S)
        # This also ends rospy's own waiting for a master, in which our thread may be.
        self._rospy.signal_shutdown("the agent has ended")
        self._thread.join(_JOIN_S)

    def waits(self) -> str | None:
        """Why the graph cannot be joined: another node of our name."""
        return self._waits

    def resolve(self, topic: str) -> str:
        """The topic's name in the graph, as the command line may remap it."""
        return self._remapped.get(topic, topic)

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages, of any type, in rospy's threads."""
        with self._lock:
            self._handlers.setdefault(self.resolve(topic), []).append(handler)
        self._wake.set()

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        """Stop receiving."""
        with self._lock:
            handlers = self._handlers.get(self.resolve(topic), [])
            if handler in handlers:
                handlers.remove(handler)
        self._wake.set()

    def definition(self, kind: str) -> Definition:
        """The definition of an installed type. Raises `SourceError` if it is not installed."""
        if kind not in self._types:
            found = installed(kind)
            try:
                self._types[kind] = found, parse(kind, found.text)
            except MessageError as error:
                raise SourceError(str(error)) from error
        return self._types[kind][1]

    def advertise(self, topic: str, kind: str) -> None:
        """Become a publisher of the topic, to which subscribers then connect: `publish` alone is too late.

        The topic is not latched, because an old command must not run later.
        """
        self.definition(kind)
        with self._lock:
            self._wanted.setdefault(self.resolve(topic), self._types[kind][0].message_class)
        self._wake.set()

    def offer(self, service: str, handler: OnTrigger) -> None:
        """Answer calls of a service, in rospy's threads."""
        with self._lock:
            self._offered[self.resolve(service)] = handler
        self._wake.set()

    def release(self, topic: str) -> None:
        """Nothing to do: a joystick or a planner on board drives on by itself."""

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message's bytes on an advertised topic; False if the node is not in the graph."""
        publisher = self._publishers.get(self.resolve(topic))
        if publisher is None:
            return False
        message = publisher.data_class()
        message.deserialize(data)
        try:
            publisher.publish(message)
        except self._rospy.ROSException:
            return False  # shutting down
        return True

    def types(self) -> Mapping[str, Sequence[str]]:
        """The topics that somebody publishes, and the types of each; none while no master answers."""
        try:
            return {topic: [kind] for topic, kind in self._master.ask("getPublishedTopics", "")}
        except ros1_master.ERRORS:
            return {}

    def connections(self, topic: str) -> int:
        """How many publishers a subscribed topic is connected to."""
        return _connections(self._subscribers.get(self.resolve(topic)))

    def listeners(self, topic: str) -> int:
        """How many subscribers an advertised topic is connected to."""
        return _connections(self._publishers.get(self.resolve(topic)))

    def living(self, base: str) -> frozenset[str]:
        """The address of the node of this name, in our namespace, if it is in the graph and answers."""
        name = self._me[: -len(self.base)] + base
        try:
            uri = ros1_master.Master(self._uri, self._me).ask("lookupNode", name)
        except ros1_master.ERRORS:
            return frozenset()
        return frozenset([uri] if self._answers(uri, name) else [])

    # All below runs in the node's own thread.

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and self.failed is None:
                self._await_master()
                self._await_name()
                if not self._stop.is_set():
                    self._take_part()
        except BaseException as error:
            # rospy may raise anything at its end.
            if not self._stop.is_set():
                self._fail(f"{type(error).__name__}: {error}")
                raise

    def _take_part(self) -> None:
        """Stay in the graph until the agent ends, or somebody ends the node."""
        try:
            self._begin()
            while not self._stop.is_set() and not self._displaced:
                self._wake.clear()
                if self._rospy.core.is_shutdown_requested():
                    self._fail("it was shut down from outside")
                    return
                self._change()
                self.ready.set()
                # The first time at once: a topic may be wanted by a pattern.
                if not self._clock.wait(self._wake, _POLL_S if self.topics else _WAIT_S):
                    self._poll()
        except Exception:
            if not self._displaced:
                raise
        if self._displaced and not self._stop.is_set():
            self._retreat()

    def _fail(self, why: str) -> None:
        if not self._stop.is_set():
            self.failed = f"the ROS node {self._me} has ended: {why}"

    def _retreat(self) -> None:
        """Leave the graph to the node that took the name, and prepare to begin again."""
        self._waits = f"another node took the name {self._me}; set sources[].node"
        _log.warning("%s: this one leaves the graph, and comes back when the other has gone", self._waits)
        self.ready.clear()
        self._rospy.signal_shutdown("another node took the name")
        with self._lock:
            self._subscribers, self._publishers, self._services = {}, {}, {}
        self._rospy = rospy()
        self._displaced = False
        self._losses += 1
        most_s = min(_MAX_RETREAT_S, 2.0**self._losses)
        self._clock.wait(self._stop, random.uniform(0, most_s))  # noqa: S311 - jitter, not secrets

    def _await_name(self) -> None:
        """Wait while another living node has our name, because the later one ends the earlier one."""
        while not self._stop.is_set():
            try:
                self._holder = self._living_namesake()
            except ros1_master.ERRORS:
                self._clock.wait(self._stop, _WAIT_S)
                self._await_master()
                continue
            if self._holder is None:
                break
            waits = f"another node is called {self._me} at {self._holder}; set sources[].node"
            if waits != self._waits:
                _log.warning("%s: waiting for it to go", waits)
            self._waits, self._losses = waits, 0
            self._clock.wait(self._stop, _WAIT_S)
        self._waits = None

    def _living_namesake(self) -> str | None:
        """The address at which a node of our name answers. The master keeps a dead node's address for
        ever."""
        _, _, registered = self._master.proxy.lookupNode(self._me, self._me)
        # A restarted master does not know yet the node that we wait for.
        for uri in (registered, self._holder):
            if uri and self._answers(uri):
                return str(uri)
        return None

    def _answers(self, uri: str, name: str | None = None) -> bool:
        try:
            status, _, told = ros1_master.proxy(uri).getName(self._me)
        except xmlrpc.client.Fault:
            return True  # only rospy's nodes tell their names
        except ros1_master.ERRORS:
            return False
        # Another node may have the port by now.
        return bool(status == 1 and told == (name or self._me))

    def _on_shutdown(self, reason: str) -> None:
        # The master ends a node only when another one takes its name.
        self._displaced = self._displaced or "[/master]" in reason
        self._wake.set()

    def _await_master(self) -> None:
        told = False
        while not self._stop.is_set():
            why = self._master.unreachable()
            if why is None:
                return
            if not told:
                _log.warning("no ROS master at %s (%s), waiting for it", self._uri, why)
            told = True
            self._clock.wait(self._stop, _WAIT_S)

    def _begin(self) -> None:
        rospy = self._rospy
        # rospy would configure Python's logging from its own file.
        rospy.core.configure_logging = lambda *_args, **_settings: None
        for name, level in _LOGGERS.items():
            logging.getLogger(name).setLevel(level)
        rospy.core.add_preshutdown_hook(self._on_shutdown)
        ros1_master.mend(self._me)
        _read_directly(self._handlers)
        # The agent handles signals, names are resolved already, and /clock is of no use to the agent.
        rospy.init_node(
            self.base, argv=[self.base], disable_signals=True, disable_rosout=True, disable_rostime=True
        )
        self._absent = False
        _log.info("ROS node %s at %s", rospy.get_name(), self._uri)

    def _change(self) -> None:
        """Give rospy the wanted subscriptions and publishers."""
        with self._lock:
            handlers = {topic: tuple(handlers) for topic, handlers in self._handlers.items()}
            wanted, offered = dict(self._wanted), dict(self._offered)
        for topic, those in handlers.items():
            subscriber = self._subscribers.get(topic)
            if those and subscriber is None:
                self._subscribers[topic] = self._rospy.Subscriber(
                    topic, self._rospy.AnyMsg, self._deliver, callback_args=topic, tcp_nodelay=True
                )
            elif subscriber is not None and not those:
                del self._subscribers[topic]
                subscriber.unregister()
        for topic, message_class in wanted.items():
            if topic not in self._publishers:
                self._publishers[topic] = self._rospy.Publisher(
                    topic, _bytes_of(self._rospy.AnyMsg, message_class), queue_size=_QUEUE, tcp_nodelay=True
                )

        for service, handler in offered.items():
            if service not in self._services:
                self._services[service] = self._rospy.Service(
                    service, trigger(), functools.partial(_answered, handler)
                )

    def _deliver(self, message: Any, topic: str) -> None:
        for handler in self._handlers[topic]:
            handler(message._connection_header, message._buff)  # noqa: SLF001 - rospy's only names for them

    def _poll(self) -> None:
        try:
            # One request for all: this is the node's only work while no message comes.
            questions: Any = xmlrpc.client.MultiCall(self._master.proxy)
            questions.getSystemState(self._me)
            questions.getParam(self._me, "/use_sim_time")
            questions.lookupNode(self._me, self._me)
            (_, _, (publishers, subscribers, services)), (status, _, sim_time), (_, _, uri) = tuple(
                questions()
            )
            self.sim_time = status == 1 and bool(sim_time)
            if self._absent:
                _log.info("the ROS master at %s answers again", self._uri)
            self._absent = False
            self.topics = tuple(topic for topic, _ in publishers)
            if uri and uri != self._rospy.get_node_uri() and self._answers(uri):
                # To register again would end the other one.
                self._displaced = True
                return
            self._register_again(dict(publishers), dict(subscribers), dict(services))
            self._connect(dict(publishers))
        except ros1_master.ERRORS as error:
            if not self._absent:
                _log.warning("the ROS master at %s does not answer: %s", self._uri, error)
            self._absent = True
        else:
            if self._restored:
                _log.warning("the ROS master had forgotten %s: registered again", ", ".join(self._restored))
            self._restored = []

    def _register_again(
        self, publishers: Mapping[str, Any], subscribers: Mapping[str, Any], services: Mapping[str, Any]
    ) -> None:
        me, api = self._me, self._rospy.get_node_uri()
        unheard = [topic for topic in self._subscribers if me not in subscribers.get(topic, ())]
        unpublished = [topic for topic in self._publishers if me not in publishers.get(topic, ())]
        for topic in unheard:
            publishing = self._master.ask("registerSubscriber", topic, _ANY_TYPE, api)
            self._restored.append(topic)
            self._tell(topic, publishing)
        for topic in unpublished:
            kind = self._wanted[topic]._type  # noqa: SLF001 - genpy's own name for it
            self._master.ask("registerPublisher", topic, kind, api)
            self._restored.append(topic)
        for service in self._services:
            if me not in services.get(service, ()):
                self._master.ask("registerService", service, self._services[service].uri, api)
                self._restored.append(service)

    def _connect(self, publishers: Mapping[str, Any]) -> None:
        """Try again if there are more publishers than connections, because each is tried only once."""
        for topic, subscriber in self._subscribers.items():
            names = publishers.get(topic, ())
            if len(names) > _connections(subscriber):
                found = [self._master.proxy.lookupNode(self._me, name) for name in names]
                self._tell(topic, [uri for status, _, uri in found if status == 1])

    def _tell(self, topic: str, uris: list[str]) -> None:
        """Tell rospy of a topic's publishers as a master does: it connects to the unknown ones."""
        if uris:
            ros1_master.proxy(self._rospy.get_node_uri()).publisherUpdate("/master", topic, uris)


def _read_directly(handlers: Mapping[str, Sequence[OnBytes]]) -> None:
    """Let the rospy that is imported now hand a topic's messages to its handlers as they are on the socket.

    Its own way, over a buffer, an object and a list for each message, costs more than all that the agent
    does with a message. It still connects, and reads what came together with a connection's header.
    """
    transports = importlib.import_module("rospy.impl.tcpros_base").TCPROSTransport
    subscription = importlib.import_module("rospy.impl.tcpros_pubsub").TCPROSSub
    exceptions: Any = importlib.import_module("rospy.exceptions")
    receive_once, read_size = transports.receive_once, struct.Struct("<I").unpack

    def receive(transport: Any) -> list[Any]:
        protocol, header = transport.protocol, transport.header
        if not isinstance(protocol, subscription) or transport.read_buff.tell():
            messages: list[Any] = receive_once(transport)
            return messages
        takers = handlers[protocol.resolved_name]
        # rospy may close its descriptor at any time, and the number may then be another file's.
        with os.fdopen(os.dup(transport.socket.fileno()), "rb", protocol.buff_size) as stream:
            while not transport.done:
                size = 1
                try:
                    head = stream.read(4)
                    size = read_size(head)[0] if len(head) == 4 else 1
                    data = stream.read(size)
                except MemoryError as error:
                    # What follows would be read from the middle of a message. rospy connects again.
                    _log.error("topic %s: no memory for %d bytes", protocol.resolved_name, size)
                    raise exceptions.TransportException("no memory for a message") from error
                if len(data) != size:
                    raise exceptions.TransportTerminated("the publisher has closed the connection")
                try:
                    for take in takers:
                        take(header, data)
                except Exception:  # noqa: BLE001 - whatever a handler raises, the topic must be heard on
                    _log.exception("topic %s: a message could not be taken", protocol.resolved_name)
        return []

    transports.receive_once = receive


def _connections(endpoint: Any) -> int:
    return int(endpoint.get_num_connections()) if endpoint is not None else 0


def _answered(handler: OnTrigger, _request: Any) -> dict[str, Any]:
    """A response as rospy makes one, by its fields."""
    success, message = handler()
    return {"success": success, "message": message}


def _bytes_of(any_message: Any, message_class: Any) -> Any:
    """A class with which rospy publishes bytes under a type's name, without making objects of them."""
    names = ("_type", "_md5sum", "_full_text")
    return type("Bytes", (any_message,), {name: getattr(message_class, name) for name in names})
