"""A session in a ROS 2 graph: rclpy, as far as the agent's node needs it.

rclpy's executor makes a new wait set for each message and looks at every entity before and after, which costs
more than all that the agent does with a message. `RclpySession` keeps one wait set, and takes all that is
ready each time it wakes. It uses what Humble, Jazzy and Rolling have in common. A distribution whose rclpy
lacks the pieces runs on the executor.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import sys
import time
from typing import Any, Callable, Mapping, Sequence

from iort_agent.common.threads import brief
from iort_agent.ros.qos import Offer, Request
from iort_agent.ros.ros1_types import OnTrigger
from iort_agent.ros.ros2_session import INCOMPATIBLE, LOST, Endpoint, Publisher, Subscription, Take, Told

_log = logging.getLogger(__name__)

# A topic that is faster than the agent must let the others have their turn.
_AT_ONCE = 64
# Messages that come closer together are fetched together a little later: waking costs more than they do.
_BUSY_S, _PAUSE_S = 0.002, 0.004
# Messages for which nobody waits are fetched so seldom.
_REST_S = 0.05
# How long each of several executors waits in turn.
_TURN_S = 0.01
_PIECES = (
    "add_event", "add_guard_condition", "add_service", "add_subscription", "clear_entities",
    "get_ready_entities", "wait",
)  # fmt: skip
_RELIABLE, _TRANSIENT_LOCAL = 1, 1
_WATCHED = {"message_lost": LOST, "incompatible_qos": INCOMPATIBLE}


class _Member:
    """A node of rclpy in a context of its own: the agent has its own handlers of signals.

    ``kinds`` are the types of its topics: Fast DDS allows a participant only one type of a topic.
    """

    def __init__(self, name: str, arguments: Sequence[str], namespace: str | None = None) -> None:
        self.context: Any = importlib.import_module("rclpy.context").Context()
        # Without rcl's own log: it would write files into ROS_HOME, which a service may not.
        self.context.init(arguments, initialize_logging=False)
        parameter: Any = importlib.import_module("rclpy.parameter").Parameter
        self.node: Any = importlib.import_module("rclpy.node").Node(
            name,
            context=self.context,
            namespace=namespace,
            enable_rosout=False,
            # Nobody would answer: only what is wanted is waited for.
            start_parameter_services=False,
            parameter_overrides=[parameter("start_type_description_service", value=False)],
        )
        self.kinds: dict[str, list[Any]] = {}

    def takes(self, topic: str, message_class: Any) -> bool:
        """Whether the topic can have this type here."""
        return all(one is message_class for one in self.kinds.get(topic, ()))

    def close(self) -> None:
        self.node.destroy_node()
        self.context.try_shutdown()


class RclpySession:
    """The session of the agent's node, with further nodes for topics that have several types. Its attributes
    are for the parts of this module."""

    def __init__(self, name: str) -> None:
        first = _Member(name, sys.argv)
        self.context, self.node = first.context, first.node
        self.members = [first]
        self.name = f"{self.node.get_namespace().rstrip('/')}/{self.node.get_name()}"
        self.sim_time = bool(self.node.get_parameter("use_sim_time").value)
        self._qos: Any = importlib.import_module("rclpy.qos")
        self.guard = self.node.create_guard_condition(lambda: None)
        self.subscriptions: list[_Subscription] = []
        self.services: list[_Service] = []
        self.waiter: Any = _WaitSet(self) if _WaitSet.possible() else _Executor(self)

    def resolve(self, topic: str) -> str:
        return str(self.node.resolve_topic_name(topic))

    def topics(self) -> Mapping[str, Sequence[str]]:
        return dict(self.node.get_topic_names_and_types())

    def publishers(self, topic: str) -> Sequence[Endpoint]:
        return [_endpoint(info) for info in self.node.get_publishers_info_by_topic(topic)]

    def count(self, topic: str) -> int:
        return int(self.node.count_publishers(topic))

    def nodes(self, name: str) -> Sequence[str]:
        # Each node has a publisher of this topic.
        infos = self.node.get_publishers_info_by_topic("/parameter_events")
        return [bytes(info.endpoint_gid).hex() for info in infos if _endpoint(info).node == name]

    def subscribe(
        self, topic: str, message_class: Any, request: Request, take: Take, told: Told
    ) -> Subscription:
        member, profile = self._member(topic, message_class), self._profile(request)
        subscription = _Subscription(self, member, topic, (message_class, profile), take=take, told=told)
        subscription.patient = request.patient
        self.subscriptions.append(subscription)
        self.waiter.change()
        return subscription

    def advertise(self, topic: str, message_class: Any, depth: int) -> Publisher:
        profile = self._profile(Request(Offer(reliable=True, transient_local=False), depth))
        member = self._member(topic, message_class)
        member.kinds.setdefault(topic, []).append(message_class)
        return _Publisher(member.node.create_publisher(message_class, topic, profile))

    def offer(self, service: str, trigger: Any, handler: OnTrigger) -> None:
        self.services.append(_Service(self, service, trigger, handler))
        self.waiter.change()

    def wait(self, timeout_s: float) -> None:
        self.waiter.wait(timeout_s)

    def events(self) -> None:
        self.waiter.events()

    def wake(self) -> None:
        self.guard.trigger()

    def close(self) -> None:
        self.waiter.close()
        for subscription in self.subscriptions[:]:
            subscription.close()
        for member in self.members:
            member.close()

    def _member(self, topic: str, message_class: Any) -> _Member:
        for member in self.members:
            if member.takes(topic, message_class):
                return member
        # Without the command line: its names are resolved already.
        name = f"{self.node.get_name()}_{len(self.members)}"
        self.members.append(_Member(name, [], self.node.get_namespace()))
        return self.members[-1]

    def _profile(self, request: Request) -> Any:
        reliability, durability = self._qos.QoSReliabilityPolicy, self._qos.QoSDurabilityPolicy
        return self._qos.QoSProfile(
            depth=request.depth,
            reliability=reliability.RELIABLE if request.offer.reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if request.offer.transient_local else durability.VOLATILE,
        )


def _endpoint(info: Any) -> Endpoint:
    profile = info.qos_profile
    # Humble tells no hash, and a publisher's middleware may tell an invalid one.
    type_hash = str(getattr(info, "topic_type_hash", ""))
    return Endpoint(
        info.topic_type,
        Offer(int(profile.reliability) == _RELIABLE, int(profile.durability) == _TRANSIENT_LOCAL),
        type_hash if type_hash.startswith("RIHS") else "",
        f"{info.node_namespace.rstrip('/')}/{info.node_name}",
    )


class _Subscription:
    """The rclpy subscription of one type of a topic."""

    def __init__(
        self,
        session: RclpySession,
        member: _Member,
        topic: str,
        kind: tuple[Any, Any],
        *,
        take: Take,
        told: Told,
    ) -> None:
        self.take, (self.message_class, profile) = take, kind
        self._session, self._member, self._topic = session, member, topic
        self.patient = False
        watched: dict[str, Callable[[Any], None]] = {
            event: _teller(told, reason) for event, reason in _WATCHED.items()
        }
        while True:
            try:
                self.made: Any = member.node.create_subscription(
                    self.message_class,
                    topic,
                    take,
                    profile,
                    raw=True,
                    event_callbacks=_events(watched),
                )
                break
            except Exception as error:
                # Some middlewares do not tell how many messages they have lost.
                if type(error).__name__ != "UnsupportedEventTypeError" or "message_lost" not in watched:
                    raise
                del watched["message_lost"]
        self.handle: Any = self.made.handle
        member.kinds.setdefault(topic, []).append(self.message_class)

    def take_some(self, most: int = _AT_ONCE) -> bool:
        """Deliver what waits; whether that was less than ``most`` messages."""
        take_message, message_class, take = self.handle.take_message, self.message_class, self.take
        for _ in range(most):
            taken = take_message(message_class, True)
            if taken is None:
                return True
            if self.patient and not taken[1].get("received_timestamp"):
                # This middleware does not tell when a message came: the agent's clock must.
                self.patient = False
                self._session.waiter.change()
            take(*taken)
        return False

    def publishers(self) -> int:
        count = getattr(self.made, "get_publisher_count", None)
        return int(count() if count is not None else self._member.node.count_publishers(self._topic))

    def drain(self) -> None:
        while not self.take_some():
            pass

    def close(self) -> None:
        session = self._session
        if self in session.subscriptions:
            session.subscriptions.remove(self)
            session.waiter.change()
            self._member.kinds[self._topic].remove(self.message_class)
            self._member.node.destroy_subscription(self.made)


def _teller(told: Told, reason: str) -> Callable[[Any], None]:
    return lambda event: told(reason, int(event.total_count_change))


def _events(watched: Mapping[str, Callable[[Any], None]]) -> Any:
    try:
        module = importlib.import_module("rclpy.event_handler")
    except ImportError:  # Humble
        module = importlib.import_module("rclpy.qos_event")
    return module.SubscriptionEventCallbacks(**watched, use_default_callbacks=False)


class _Publisher:
    def __init__(self, made: Any) -> None:
        self._made = made

    def publish(self, data: bytes) -> None:
        self._made.publish(data)

    def subscribers(self) -> int:
        return int(self._made.get_subscription_count())


class _Service:
    """A service of the type std_srvs/srv/Trigger."""

    def __init__(self, session: Any, name: str, trigger: Any, handler: OnTrigger) -> None:
        self._session, self._handler = session, handler
        self.made: Any = session.node.create_service(trigger, name, self._answer)
        self.handle: Any = self.made.handle

    def serve(self) -> None:
        """Take the requests that wait."""
        for _, header in iter(self._request, (None, None)):
            brief("ros2 service", functools.partial(self._respond, header))

    def _request(self) -> tuple[Any, Any]:
        found: tuple[Any, Any] = self.handle.service_take_request(self.made.srv_type.Request)
        return found

    def _respond(self, header: Any) -> None:
        response = self._response()
        with contextlib.suppress(Exception):  # the session may be closed by now
            self.made.send_response(response, header)

    def _response(self) -> Any:
        success, message = self._handler()
        return self.made.srv_type.Response(success=success, message=message)

    async def _answer(self, _request: Any, _response: Any) -> Any:
        """Called by the executor only."""
        future: Any = importlib.import_module("rclpy.task").Future(executor=self._session.waiter.executor)

        def respond() -> None:
            future.set_result(self._response())
            self._session.wake()

        brief("ros2 service", respond)
        return await future


class _WaitSet:
    """One wait set over all subscriptions and services, filled again for each wait as rcl wants it. Once the
    patient subscriptions were taken, the others are waited for alone for a moment. The events of
    subscriptions are rare, and have a wait set of their own that never waits."""

    def __init__(self, session: RclpySession) -> None:
        self._session = session
        self._rclpy = _implementation()
        self._busy = False
        # Until then, patient subscriptions are not waited for.
        self._rest_until = 0.0
        self.change()

    @staticmethod
    def possible() -> bool:
        """Whether this rclpy has the pieces."""
        wait_set = getattr(_implementation(), "WaitSet", None)
        return all(hasattr(wait_set, name) for name in _PIECES)

    def change(self) -> None:
        """The session's subscriptions or services are others now."""
        self._set: Any = None
        self._ready: frozenset[Any] = frozenset()

    def _fill(self) -> None:
        session = self._session
        self._subscriptions = {one.handle.pointer: one for one in session.subscriptions}
        self._services = {one.handle.pointer: one for one in session.services}
        self._handlers = [handler for one in session.subscriptions for handler in one.made.event_handlers]
        make, context = self._rclpy.WaitSet, session.context.handle
        self._set = make(len(self._subscriptions), 1, 0, 0, len(self._services), 0, context)
        self._events = make(0, 0, 0, 0, 0, len(self._handlers), context) if self._handlers else None

    def wait(self, timeout_s: float) -> None:
        if self._set is None:
            self._fill()
        wait_set = self._set
        wait_set.clear_entities()
        add = wait_set.add_subscription
        rest_s = self._rest_until - time.monotonic()
        if rest_s > 0:
            timeout_s = min(timeout_s, rest_s)
        for one in self._subscriptions.values():
            if rest_s <= 0 or not one.patient:
                add(one.handle)
        for service in self._services.values():
            wait_set.add_service(service.handle)
        wait_set.add_guard_condition(self._session.guard.handle)
        if self._busy:
            time.sleep(_PAUSE_S)
        began = time.monotonic()
        wait_set.wait(int(timeout_s * 1e9))
        at_once = time.monotonic() - began < _BUSY_S
        ready, found = wait_set.get_ready_entities("subscription"), self._subscriptions
        hasty, rest = False, []
        for pointer in sorted(ready, key=lambda pointer: found[pointer].patient):
            if found[pointer].patient:
                rest.append(found[pointer].take_some())
                continue
            hasty = True
            # To ask for a message that is not there takes as long as to take one: several are asked for only
            # where there was one the last time, too.
            found[pointer].take_some(_AT_ONCE if pointer in self._ready else 1)
        self._busy, self._ready = at_once and hasty, frozenset(ready)
        if rest and all(rest):
            self._rest_until = time.monotonic() + _REST_S
        if self._services:
            for pointer in wait_set.get_ready_entities("service"):
                self._services[pointer].serve()

    def events(self) -> None:
        if self._set is None:
            self._fill()
        if self._events is None:
            return
        self._events.clear_entities()
        for handler in self._handlers:
            handler.add_to_wait_set(self._events)
        self._events.wait(0)
        for handler in self._handlers:
            if handler.is_ready(self._events):
                told = handler.take_data()
                if told is not None:
                    handler.callback(told)

    def close(self) -> None:
        self._set = self._events = None


def _implementation() -> Any:
    return importlib.import_module("rclpy.impl.implementation_singleton").rclpy_implementation


class _Executor:
    """rclpy's executor, which also handles the events."""

    def __init__(self, session: RclpySession) -> None:
        _log.warning("this rclpy has no wait sets: ROS messages take its executor, and more processor time")
        self._session = session
        self._executors: list[Any] = []
        self.change()
        self.executor: Any = self._executors[0]

    def change(self) -> None:
        """Each context has an executor of its own. It looks by itself."""
        executors: Any = importlib.import_module("rclpy.executors")
        for member in self._session.members[len(self._executors) :]:
            self._executors.append(executors.SingleThreadedExecutor(context=member.context))
            self._executors[-1].add_node(member.node)

    def wait(self, timeout_s: float) -> None:
        several = len(self._executors) > 1
        for executor in self._executors:
            executor.spin_once(timeout_sec=min(timeout_s, _TURN_S) if several else timeout_s)

    def events(self) -> None:
        """They are handled in `wait`."""

    def close(self) -> None:
        for executor in self._executors:
            executor.shutdown()
