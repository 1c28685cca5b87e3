"""The uplink to AWS IoT Core: MQTT 5 over mTLS, with AWS' own client.

The client's own reconnect has no minimum wait (measured: 0.25 s between attempts) and never notices a new
certificate. So our thread stops the client after every failure and every loss, and starts it again when
`iort_agent.mqtt.failures` says so. When the connection is lost, publishes fail: only the spool keeps
batches. Every session is clean: a broker that lost the session would otherwise send the robot nothing more.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from concurrent.futures import Future
from typing import Any, Callable

from awscrt import mqtt5

from iort_agent.common.state import Connection
from iort_agent.common.threads import Clock, Supervised
from iort_agent.errors import IdentityError, UplinkError
from iort_agent.mqtt.client import Broker, ClientFactory, Network, keep_state, send_at_once
from iort_agent.mqtt.dispatch import Dispatcher, Subscriptions
from iort_agent.mqtt.failures import (
    SETTLED_S,
    SHORTEST_S,
    UNSTEADY,
    Backoff,
    Causes,
    error_name,
    explain,
    said,
    why_not_connected,
)
from iort_agent.mqtt.uplink import Done, MqttMessage, OnConnection, OnMessage

_log = logging.getLogger(__name__)

# A frozen broker is noticed after the keep-alive and the wait for its answer.
KEEP_ALIVE_S = 30
PING_TIMEOUT_S = 10
# How often to check whether certificate, key or root_ca were replaced.
_LOOK_S = 2.0
_CLIENT_STOPS_S = 15.0
_QOS = (mqtt5.QoS.AT_MOST_ONCE, mqtt5.QoS.AT_LEAST_ONCE)
_WE_STOPPED = "AWS_ERROR_MQTT5_USER_REQUESTED_STOP"


class IotCore:
    """An `iort_agent.mqtt.uplink.Uplink` to one broker, as one robot."""

    def __init__(
        self,
        broker: Broker,
        *,
        clock: Clock,
        dispatcher: Dispatcher,
        keep_alive_s: int = KEEP_ALIVE_S,
        ping_timeout_s: float = PING_TIMEOUT_S,
        network: Callable[[], Network] = Network,
        backoff: Backoff | None = None,
    ) -> None:
        self._broker, self._endpoint = broker, f"{broker.endpoint}:{broker.port}"
        self._client_id = broker.client_id
        self._clock = clock
        self._dispatcher = dispatcher
        self._factory = ClientFactory(broker, keep_alive_s=keep_alive_s, ping_timeout_s=ping_timeout_s)
        self._client: Any = None
        self._generation = 0
        self._thread = Supervised("uplink", self._keep_connected)
        self._backoff = backoff or Backoff()
        self._network = network
        self._causes = Causes()
        # Set when the attempt or the connection has ended, or should end.
        self._down, self._client_stopped = threading.Event(), threading.Event()
        self._stop = threading.Event()
        self._pace = UNSTEADY
        self._connected = False
        self._connects = 0
        self._since = clock.monotonic()
        self._last_error: str | None = None
        self._handlers: list[OnConnection] = []
        self._subscriptions = Subscriptions(
            dispatcher,
            subscribe=self._subscribe,
            usable=lambda: self._connected and not self._stop.is_set(),
            refused=self._note_error,
        )

    def on_connection(self, handler: OnConnection) -> None:
        self._handlers.append(handler)

    def subscribe(self, topic_filter: str, handler: OnMessage) -> None:
        self._subscriptions.add(topic_filter, handler)

    def subscribed(self, topic_filter: str) -> bool:
        return topic_filter in self._subscriptions.confirmed

    def connected(self) -> bool:
        return self._connected

    def status(self) -> Connection:
        return Connection(
            self._connected,
            self._clock.monotonic() - self._since,
            self._connects,
            self._last_error,
            self._factory.certificate_id(),
            self._endpoint,
        )

    def start(self) -> None:
        """Connect in the background. Raises `UplinkError` if the certificate or the key cannot be used."""
        try:
            self._new_client()
        except IdentityError as error:
            raise UplinkError(str(error)) from error
        except Exception as error:
            raise UplinkError(f"root_ca or the certificate cannot be used: {error}") from error
        self._dispatcher.start()
        _log.info("connecting to %s as %s", self._endpoint, self._client_id)
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        if not self._thread.is_alive():
            return
        until = self._clock.monotonic() + timeout_s
        if self._connected and self._subscriptions.confirmed:
            gone = threading.Event()
            filters = sorted(self._subscriptions.confirmed)
            future = self._client.unsubscribe(mqtt5.UnsubscribePacket(topic_filters=filters))
            future.add_done_callback(lambda _: gone.set())
            gone.wait(timeout_s / 2)
        self._stop.set()
        self._down.set()
        self._thread.join(max(0.1, until - self._clock.monotonic()))
        if self._thread.is_alive():
            _log.warning("the connection did not close in time")
        self._dispatcher.stop(max(0.1, until - self._clock.monotonic()))

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Done) -> None:
        if not self._connected:
            self._dispatcher.post(lambda: done(UplinkError("not connected")))
            return
        packet = mqtt5.PublishPacket(topic=topic, payload=payload, qos=_QOS[qos])
        if qos:
            self._operate(lambda: self._client.publish(packet), lambda future: done(_publish_error(future)))
        else:
            # A call in the dispatcher's thread would cost as much as the message.
            self._begin(lambda: self._client.publish(packet)).add_done_callback(
                lambda future: done(_write_error(future))
            )

    def _operate(self, start: Callable[[], Future[Any]], finish: Callable[[Future[Any]], None]) -> None:
        """Start an operation of the client; the dispatcher calls ``finish`` with its result or failure."""
        self._begin(start).add_done_callback(lambda result: self._dispatcher.post(lambda: finish(result)))

    @staticmethod
    def _begin(start: Callable[[], Future[Any]]) -> Future[Any]:
        """Start an operation of the client; an exception becomes a failed future."""
        try:
            return start()
        except Exception as error:  # noqa: BLE001 - the client raises AwsCrtError, TypeError, ...
            future: Future[Any] = Future()
            future.set_exception(error)
            return future

    # Called in the uplink's own thread.

    def _keep_connected(self) -> None:
        """Connect again and again until `stop`."""
        with contextlib.closing(self._network()) as network:
            self._connect_until_stop(network)

    def _connect_until_stop(self, network: Network) -> None:
        while not self._stop.is_set():
            began = self._clock.monotonic()
            self._down.clear()
            self._client_stopped.clear()
            self._pace = UNSTEADY
            if self._stop.is_set():
                break
            try:
                self._client.start()
                while not self._clock.wait(self._down, _LOOK_S):
                    if self._connected and self._factory.replaced():
                        _log.info("%s was replaced: connecting with it", self._broker.certificate)
                        self._backoff.reset()
                        break
            finally:
                # After an error, too: a client that is left started would connect again tomorrow.
                self._stop_client()
            if not self._stop.is_set():
                self._pause(began, network)

    def _stop_client(self) -> None:
        self._client.stop(mqtt5.DisconnectPacket() if self._connected else None)
        if not self._client_stopped.wait(_CLIENT_STOPS_S):
            _log.warning("the MQTT client did not stop in time; using a new one")
            self._try_new_client()

    def _pause(self, began: float, network: Network) -> None:
        """Wait until the next attempt is due. Replaced files make it due a second after the last one, and a
        network that comes does after the shortest wait for the cause."""
        earliest, pace = began + SHORTEST_S, self._pace
        due = max(earliest, self._clock.monotonic() + self._backoff.next_s(pace))
        while not self._stop.is_set():
            if self._factory.replaced():
                due = earliest
                self._try_new_client()
            if network.came():
                now = self._clock.monotonic()
                due = min(due, now + self._backoff.came_back_s(pace, now - began))
            left = due - self._clock.monotonic()
            if left <= 0:
                return
            self._clock.wait(self._stop, min(left, SHORTEST_S))

    def _try_new_client(self) -> None:
        try:
            self._new_client()
        except Exception as error:  # noqa: BLE001 - the library raises anything for a wrong file
            _log.error(
                "certificate, private_key or root_ca was replaced by one that cannot be used; "
                "still using the one before: %s",
                error,
            )

    def _new_client(self) -> None:
        generation = self._generation + 1

        def ours(handler: Callable[[Any], None]) -> Callable[[Any], None]:
            # Ignores events of a client that was replaced.
            return lambda data: handler(data) if self._generation == generation else None

        client = self._factory.make(
            on_publish_received=ours(self._on_publish),
            on_lifecycle_connection_success=ours(self._on_connected),
            on_lifecycle_connection_failure=ours(self._on_refused),
            on_lifecycle_disconnection=ours(self._on_lost),
            on_lifecycle_stopped=ours(lambda _: self._client_stopped.set()),
        )
        self._client, self._generation = client, generation

    # Called in the client's own thread, which must not wait.

    def _on_publish(self, data: Any) -> None:
        at = self._clock.monotonic()
        packet = data.publish_packet
        self._subscriptions.hand_out(MqttMessage(packet.topic, bytes(packet.payload or b""), at))

    def _on_connected(self, _: Any) -> None:
        keep_state()
        send_at_once(self._broker.port)
        self._switch(connected=True)
        self._connects += 1
        self._causes.connected()
        _log.info("connected to %s as %s", self._endpoint, self._client_id)
        self._dispatcher.post(self._subscriptions.renew)
        self._tell(connected=True)

    def _on_refused(self, data: Any) -> None:
        if not self._stop.is_set():
            cause = why_not_connected(
                data,
                client_id=self._client_id,
                validity=self._factory.validity,
                now_us=self._clock.now_us(),
                hung_up=self._causes.hung_up,
            )
            self._pace = cause.pace
            self._last_error = cause.text
            level = logging.DEBUG
            if self._causes.is_news(cause):
                level = logging.ERROR if cause.pace.person else logging.WARNING
            _log.log(level, "cannot connect to %s as %s: %s", self._endpoint, self._client_id, cause.text)
        self._down.set()

    def _on_lost(self, data: Any) -> None:
        self._subscriptions.lost()
        if self._clock.monotonic() - self._since > SETTLED_S:
            self._backoff.reset()
        self._switch(connected=False)
        packet = data.disconnect_packet
        if self._stop.is_set() or error_name(data.exception) == _WE_STOPPED:
            _log.info("disconnected from %s", self._endpoint)
        elif packet is not None and packet.reason_code == mqtt5.DisconnectReasonCode.SESSION_TAKEN_OVER:
            self._last_error = f"another client has connected as {self._client_id}"
            _log.error(
                "disconnected: another client has connected as %s. Only one client may use a robot's name: "
                "two would take the connection from each other again and again",
                self._client_id,
            )
        else:
            self._last_error = said(packet) if packet is not None else explain(data.exception)
            _log.warning("connection to %s lost: %s", self._endpoint, self._last_error)
        self._tell(connected=False)
        self._down.set()

    def _switch(self, *, connected: bool) -> None:
        self._connected = connected
        self._since = self._clock.monotonic()

    def _tell(self, *, connected: bool) -> None:
        for handler in self._handlers:
            self._dispatcher.post(functools.partial(handler, connected))

    # Called by the dispatcher.

    def _subscribe(self, topic_filter: str, done: Callable[[Future[Any]], None]) -> None:
        packet = mqtt5.SubscribePacket([mqtt5.Subscription(topic_filter, mqtt5.QoS.AT_LEAST_ONCE)])
        self._operate(functools.partial(self._client.subscribe, packet), done)

    def _note_error(self, text: str) -> None:
        self._last_error = text


def _write_error(future: Future[Any]) -> UplinkError | None:
    error = future.exception()
    return UplinkError(explain(error)) if error is not None else None


def _publish_error(future: Future[Any]) -> UplinkError | None:
    error = _write_error(future)
    if error is not None:
        return error
    puback = future.result().puback
    code = getattr(puback, "reason_code", None)
    # QoS 0 has no reason code. Below 128 is a success, such as "no matching subscribers".
    if code is None or code < 128:
        return None
    return UplinkError(said(puback))
