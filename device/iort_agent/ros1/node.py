"""The agent's node in a ROS 1 graph: one in a process, as rospy has it, shared by all who need it.

rospy registers with the master once and never again, so that a node is deaf after the master's
restart, or connects to no publisher that came while it was away. The node's own thread asks the master
every few seconds what it knows and registers again what it has forgotten, without dropping the
connections that still stand. It also waits for a master that is not there yet, and for another node of
its name to go: a master ends the older one of two. Nobody who uses the node ever waits for either.
"""

from __future__ import annotations

import http.client
import importlib
import logging
import random
import sys
import threading
import xmlrpc.client
from typing import Any, Callable, Mapping

from iort_agent.clock import Clock, SystemClock
from iort_agent.errors import SourceError
from iort_contract.limits import MessageError
from iort_contract.ros1.definition import Definition, parse

_log = logging.getLogger(__name__)

DEFAULT_NODE = "iort_agent"
ANY_TYPE = "*"
_POLL_S = 4.0
_WAIT_S = 1.0
# Two that took the name from each other must not try again at the same moment, nor often.
_MAX_RETREAT_S = 60.0
_MASTER_TIMEOUT_S = 3.0
# rospy hands the last messages to threads of its own, and says of none when it is written.
_LAST_WRITE_S = 0.2
_QUEUE = 10
# rospy logs a traceback for every publisher that goes; what matters of it, we say.
_LOGGERS = {
    "rospy": logging.CRITICAL,
    "rosout": logging.ERROR,
    "topicmanager": logging.ERROR,
    "xmlrpc": logging.ERROR,
}
_MASTER_ERRORS = (OSError, xmlrpc.client.Error, http.client.HTTPException)

# Takes a message: the publisher's connection header, and the message's bytes.
OnBytes = Callable[[Mapping[str, str], bytes], None]

_lock = threading.Lock()
_shared: list[Node] = []

_HELP = (
    "the agent's Python cannot import rospy. ROS 1 installs it for the system's Python only: "
    "`source /opt/ros/noetic/setup.bash` (Debian: apt install python3-rospy), then "
    "`/usr/bin/python3 -m venv --system-site-packages <folder>` and install the agent into that"
)


def shared(name: str = DEFAULT_NODE, clock: Clock | None = None) -> Node:
    """The process' node, to be released by everybody who asked for it.

    Raises `SourceError` without rospy, and for a second name: a process is one node.
    """
    with _lock:
        if not _shared:
            _shared.append(Node(name, _rospy(), clock or SystemClock()))
        node = _shared[0]
        if node.name != name:
            raise SourceError(f"the agent is the ROS node {node.name} already, and cannot be {name} too")
        node.users += 1
        return node


def _rospy() -> Any:
    """rospy, imported anew where it was shut down: a node begins once for each import."""
    core = sys.modules.get("rospy.core")
    if core is not None and core.is_shutdown_requested():
        for module in [name for name in sys.modules if name.partition(".")[0] == "rospy"]:
            del sys.modules[module]
    try:
        return importlib.import_module("rospy")
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error


def definition_of(kind: str) -> tuple[Definition, Any]:
    """An installed message type's definition and class. Raises `SourceError` if it is not there."""
    try:
        found = importlib.import_module("roslib.message").get_message_class(kind)
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error
    except Exception as error:
        raise SourceError(f"the ROS message type {kind} cannot be loaded: {error}") from error
    if found is None:
        package = kind.partition("/")[0]
        raise SourceError(
            f"the ROS message type {kind} is not installed: build its package, {package}, and source the "
            f"workspace, or apt install python3-{package.replace('_', '-')}"
        )
    try:
        return parse(kind, found._full_text), found  # noqa: SLF001 - rospy's own name for it
    except MessageError as error:
        raise SourceError(str(error)) from error


class Node:
    """Use `shared`. Subscriptions and publishers may be asked for before there is a master."""

    def __init__(self, name: str, rospy: Any, clock: Clock) -> None:
        self.name = name
        self.users = 0
        self.failed: str | None = None
        self.waits: str | None = None
        self.sim_time = False
        self.ready = threading.Event()
        self._rospy = rospy
        self._clock = clock
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._handlers: dict[str, list[OnBytes]] = {}
        self._subscribers: dict[str, Any] = {}
        self._wanted: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        self._absent = False
        self._displaced = False
        self._losses = 0
        # Where the other node of our name was seen.
        self._holder: str | None = None
        rosgraph = importlib.import_module("rosgraph")
        # The command line's remappings, as every ROS node reads them.
        names = importlib.import_module("rosgraph.names")
        mappings = names.load_mappings(sys.argv)
        self._base: str = mappings.get("__name", name)
        self._me: str = names.ns_join(names.get_ros_namespace(), self._base)
        self._remapped: dict[str, str] = {
            names.resolve_name(topic, self._me): names.resolve_name(other, self._me)
            for topic, other in mappings.items()
            if not topic.startswith("__")
        }
        self._uri: str = rosgraph.get_master_uri()
        try:
            self._master = _proxy(self._uri)
        except OSError as error:
            raise SourceError(f"ROS_MASTER_URI is {self._uri!r}: {error}") from error
        self._thread = threading.Thread(target=self._run, name="ros1 node", daemon=True)

    def start(self) -> None:
        """Begin, unless somebody has already."""
        with self._lock:
            if not self._thread.is_alive() and not self._stop.is_set():
                self._thread.start()

    def release(self) -> None:
        """Say that one user needs the node no longer; with the last, it leaves the graph."""
        with _lock:
            self.users -= 1
            if self.users:
                return
            _shared.remove(self)
        self._stop.set()
        self._wake.set()
        if self._publishers:
            threading.Event().wait(_LAST_WRITE_S)
        # Also ends rospy's waiting for a master, in which our thread may be.
        self._rospy.signal_shutdown("the agent has ended")
        self._thread.join(_MASTER_TIMEOUT_S)

    def resolve(self, topic: str) -> str:
        """What a topic is called in the graph: the command line may remap it. All else takes this name."""
        return self._remapped.get(topic, topic)

    def subscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive a topic's messages of whatever type, in threads of rospy's."""
        with self._lock:
            self._handlers.setdefault(topic, []).append(handler)
        self._wake.set()

    def unsubscribe(self, topic: str, handler: OnBytes) -> None:
        """Receive no more."""
        with self._lock:
            handlers = self._handlers.get(topic, [])
            if handler in handlers:
                handlers.remove(handler)
        self._wake.set()

    def advertise(self, topic: str, message_class: Any) -> None:
        """Be a publisher of the topic, whose subscribers then connect: `publish` alone is too late."""
        with self._lock:
            self._wanted.setdefault(topic, message_class)
        self._wake.set()

    def publish(self, topic: str, data: bytes) -> bool:
        """Publish a message's bytes on an advertised topic; whether the node was there to do it."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            return False
        message = publisher.data_class()
        message.deserialize(data)
        try:
            publisher.publish(message)
        except self._rospy.ROSException:
            return False  # shutting down
        return True

    def connections(self, topic: str) -> int:
        """How many publishers a subscribed topic is connected to."""
        subscriber = self._subscribers.get(topic)
        return int(subscriber.get_num_connections()) if subscriber is not None else 0

    def listeners(self, topic: str) -> int:
        """How many subscribers an advertised topic is connected to."""
        publisher = self._publishers.get(topic)
        return int(publisher.get_num_connections()) if publisher is not None else 0

    # What follows runs in the node's own thread.

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and self.failed is None:
                self._await_master()
                self._await_name()
                if not self._stop.is_set():
                    self._take_part()
        except Exception as error:  # noqa: BLE001 - rospy raises about anything, and its thread is ours
            if not self._stop.is_set():
                _log.exception("the ROS node failed")
                self._fail(f"{type(error).__name__}: {error}")

    def _take_part(self) -> None:
        """Be in the graph until the agent ends, or somebody ends the node."""
        try:
            self._begin()
            while not self._stop.is_set() and not self._displaced:
                self._wake.clear()
                if self._rospy.core.is_shutdown_requested():
                    self._fail("it was shut down from outside")
                    return
                self._change()
                self.ready.set()
                if not self._clock.wait(self._wake, _POLL_S):
                    self._look_after()
        except Exception:
            if not self._displaced:
                raise
        if self._displaced and not self._stop.is_set():
            self._retreat()

    def _fail(self, why: str) -> None:
        if not self._stop.is_set():
            self.failed = f"the ROS node {self._me} has ended: {why}"

    def _retreat(self) -> None:
        """Leave the graph to the node that took the name, ready to begin anew."""
        self.waits = f"another node took the name {self._me}; set sources[].node"
        _log.warning("%s: this one leaves the graph, and comes back when the other has gone", self.waits)
        self.ready.clear()
        self._rospy.signal_shutdown("another node took the name")
        with self._lock:
            self._subscribers, self._publishers = {}, {}
        self._rospy = _rospy()
        self._displaced = False
        self._losses += 1
        most_s = min(_MAX_RETREAT_S, 2.0**self._losses)
        self._clock.wait(self._stop, random.uniform(0, most_s))  # noqa: S311 - jitter, not secrets

    def _await_name(self) -> None:
        """Wait while another living node has our name: whoever registers later ends the one before."""
        while not self._stop.is_set():
            try:
                self._holder = self._living_namesake()
            except _MASTER_ERRORS:
                self._clock.wait(self._stop, _WAIT_S)
                self._await_master()
                continue
            if self._holder is None:
                break
            waits = f"another node is called {self._me} at {self._holder}; set sources[].node"
            if waits != self.waits:
                _log.warning("%s: waiting for it to go", waits)
            self.waits, self._losses = waits, 0
            self._clock.wait(self._stop, _WAIT_S)
        self.waits = None

    def _living_namesake(self) -> str | None:
        """Where a node of our name answers; a dead one's registration stays at the master for ever."""
        _, _, registered = self._master.lookupNode(self._me, self._me)
        # A master that was restarted does not know yet whom we wait for.
        for uri in (registered, self._holder):
            if uri and self._answers(uri):
                return str(uri)
        return None

    def _answers(self, uri: str) -> bool:
        try:
            status, _, name = _proxy(uri).getName(self._me)
        except xmlrpc.client.Fault:
            return True  # only rospy's nodes say their names
        except _MASTER_ERRORS:
            return False
        # Another node may have the port by now.
        return bool(status == 1 and name == self._me)

    def _on_shutdown(self, reason: str) -> None:
        # The master ends a node only where another one takes its name.
        self._displaced = self._displaced or "[/master]" in reason
        self._wake.set()

    def _await_master(self) -> None:
        said = False
        while not self._stop.is_set():
            why = self._unreachable()
            if why is None:
                return
            if not said:
                _log.warning("no ROS master at %s (%s), waiting for it", self._uri, why)
            said = True
            self._clock.wait(self._stop, _WAIT_S)

    def _unreachable(self) -> str | None:
        try:
            self._ask("getPid")
        except _MASTER_ERRORS as error:
            return str(error)
        return None

    def _begin(self) -> None:
        rospy = self._rospy
        # rospy would set up Python's logging anew, from a file of its own.
        rospy.core.configure_logging = lambda *_args, **_settings: None
        for name, level in _LOGGERS.items():
            logging.getLogger(name).setLevel(level)
        rospy.core.add_preshutdown_hook(self._on_shutdown)
        # Signals are the agent's, names are resolved here already, and it has no use for /clock.
        rospy.init_node(
            self._base, argv=[self._base], disable_signals=True, disable_rosout=True, disable_rostime=True
        )
        self._absent = False
        _log.info("ROS node %s at %s", rospy.get_name(), self._uri)

    def _change(self) -> None:
        """Let rospy have the subscriptions and publishers that are wanted."""
        with self._lock:
            handlers = {topic: tuple(handlers) for topic, handlers in self._handlers.items()}
            wanted = dict(self._wanted)
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

    def _deliver(self, message: Any, topic: str) -> None:
        for handler in self._handlers[topic]:
            handler(message._connection_header, message._buff)  # noqa: SLF001 - rospy's only names for them

    def _look_after(self) -> None:
        try:
            # All in one request: this is all that the node costs while no message comes.
            questions: Any = xmlrpc.client.MultiCall(self._master)
            questions.getSystemState(self._me)
            questions.getParam(self._me, "/use_sim_time")
            questions.lookupNode(self._me, self._me)
            (_, _, (publishers, subscribers, _)), (status, _, sim_time), (_, _, uri) = tuple(questions())
            self.sim_time = status == 1 and bool(sim_time)
            self._absent = self._told_of_return()
            if uri and uri != self._rospy.get_node_uri() and self._answers(uri):
                # To register again would end the other one.
                self._displaced = True
                return
            forgotten = self._register_again(dict(publishers), dict(subscribers))
            self._connect(dict(publishers))
        except _MASTER_ERRORS as error:
            if not self._absent:
                _log.warning("the ROS master at %s does not answer: %s", self._uri, error)
            self._absent = True
        else:
            if forgotten:
                _log.warning("the ROS master had forgotten %s: registered again", ", ".join(forgotten))

    def _told_of_return(self) -> bool:
        if self._absent:
            _log.info("the ROS master at %s answers again", self._uri)
        return False

    def _register_again(self, publishers: Mapping[str, Any], subscribers: Mapping[str, Any]) -> list[str]:
        me, api = self._me, self._rospy.get_node_uri()
        forgotten = []
        for topic in self._subscribers:
            if me not in subscribers.get(topic, ()):
                self._tell(topic, self._ask("registerSubscriber", topic, ANY_TYPE, api))
                forgotten.append(topic)
        for topic in self._publishers:
            if me not in publishers.get(topic, ()):
                self._ask("registerPublisher", topic, self._wanted[topic]._type, api)  # noqa: SLF001 - as below
                forgotten.append(topic)
        return forgotten

    def _connect(self, publishers: Mapping[str, Any]) -> None:
        """Try again where there are more publishers than connections: rospy tries each once."""
        for topic in self._subscribers:
            names = publishers.get(topic, ())
            if len(names) > self.connections(topic):
                found = [self._master.lookupNode(self._me, name) for name in names]
                self._tell(topic, [uri for status, _, uri in found if status == 1])

    def _tell(self, topic: str, uris: list[str]) -> None:
        """Tell rospy of a topic's publishers as a master does: it connects to those it does not know."""
        if uris:
            _proxy(self._rospy.get_node_uri()).publisherUpdate("/master", topic, uris)

    def _ask(self, method: str, *arguments: Any) -> Any:
        status, text, value = getattr(self._master, method)(self._me, *arguments)
        if status != 1:
            raise xmlrpc.client.ResponseError(f"{method}: {text}")
        return value


def _bytes_of(any_message: Any, message_class: Any) -> Any:
    """A class for rospy to publish bytes under a type's name, without making objects of them."""
    names = ("_type", "_md5sum", "_full_text")
    return type("Bytes", (any_message,), {name: getattr(message_class, name) for name in names})


class _Transport(xmlrpc.client.Transport):
    """A master that hangs must not hang us."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = _MASTER_TIMEOUT_S
        return connection


def _proxy(uri: str) -> Any:
    return xmlrpc.client.ServerProxy(uri, transport=_Transport())
