"""A connection to the broker with the rights of a viewer or a driver: MQTT 5 over WebSocket, by AWS' own
client."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import urlsplit

from awscrt import auth, mqtt5
from awsiot import mqtt5_client_builder
from typing_extensions import Self

from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet.roles import Role

_log = logging.getLogger("iort")
_CONNECT_S = 15.0
_STOPS_S = 5.0
_KEEP_ALIVE_S = 30
# Between two attempts after a lost connection.
_SHORTEST_MS, _LONGEST_MS = 1_000, 30_000

# Takes a topic and a message, in the client's own thread.
OnMessage = Callable[[str, bytes], None]


class Broker:
    """Subscribes to ``filters`` within a ``with`` block, and again after every lost connection.

    Messages are sent and heard at most once (QoS 0). Raises `StationError` if the deployment has no such
    role, if the role cannot be assumed, and if the broker refuses the connection or a subscription.
    """

    def __init__(
        self,
        cloud: Cloud,
        role: Role,
        *,
        filters: Iterable[str] = (),
        on_message: OnMessage = lambda _topic, _message: None,
    ) -> None:
        self._cloud, self._role, self._on_message = cloud, role, on_message
        self._filters = [mqtt5.Subscription(one, mqtt5.QoS.AT_MOST_ONCE) for one in filters]
        # Set once the connection can be used, or has failed.
        self._tried, self._stopped = threading.Event(), threading.Event()
        self._failure: str | None = None
        # Why the newest subscription was refused.
        self._refused: str | None = None
        self._client: mqtt5.Client

    def __enter__(self) -> Self:
        # Here, for a clear error: the client's thread would only log one.
        self._role.credentials()
        self._client = self._new_client()
        self._client.start()
        if not self._tried.wait(_CONNECT_S):
            self._failure = f"no answer within {_CONNECT_S:.0f} s"
        if self._failure is not None:
            self._stop()
            raise StationError(f"the broker refuses a {self._role.name}: {self._failure}")
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop()

    def publish(self, topic: str, message: bytes) -> None:
        """Send a message; without a connection it is dropped.

        Raises `StationError` if the broker has refused the subscriptions since: no answer would be heard.
        """
        if self._refused is not None:
            raise StationError(f"the broker refuses a {self._role.name}: {self._refused}")
        self._client.publish(mqtt5.PublishPacket(topic=topic, payload=message, qos=mqtt5.QoS.AT_MOST_ONCE))

    def _new_client(self) -> mqtt5.Client:
        gateway = urlsplit(self._cloud.endpoint_url or "")
        where = (
            {"endpoint": gateway.hostname, "port": gateway.port, "ca_filepath": self._cloud.ca_bundle}
            if gateway.hostname
            else {"endpoint": self._cloud.mqtt_endpoint}
        )
        return mqtt5_client_builder.websockets_with_default_aws_signing(
            self._cloud.region_name or "",
            auth.AwsCredentialsProvider.new_delegate(self._credentials),
            **where,
            client_id=self._role.client_id(),
            clean_session=True,
            keep_alive_interval_sec=_KEEP_ALIVE_S,
            min_reconnect_delay_ms=_SHORTEST_MS,
            max_reconnect_delay_ms=_LONGEST_MS,
            # A message of the past is worse than none.
            offline_queue_behavior=mqtt5.ClientOperationQueueBehaviorType.FAIL_ALL_ON_DISCONNECT,
            enable_metrics_collection=False,
            on_publish_received=self._heard,
            on_lifecycle_connection_success=self._connected,
            on_lifecycle_connection_failure=self._failed,
            on_lifecycle_stopped=lambda _: self._stopped.set(),
        )

    def _stop(self) -> None:
        self._client.stop()
        self._stopped.wait(_STOPS_S)

    # Called in the client's own threads.

    def _credentials(self) -> auth.AwsCredentials:
        got = self._role.credentials()
        return auth.AwsCredentials(got.access_key, got.secret_key, got.token)

    def _connected(self, _: Any) -> None:
        if not self._filters:
            self._tried.set()
            return
        asked = self._client.subscribe(mqtt5.SubscribePacket(subscriptions=self._filters))
        asked.add_done_callback(self._subscribed)

    def _subscribed(self, asked: Any) -> None:
        error = asked.exception()
        self._refused = None
        if error is not None:
            self._failure = str(error)
        elif refused := [code for code in asked.result().reason_codes if code >= 0x80]:
            self._failure = self._refused = f"its subscription is refused ({refused[0].name})"
        self._tried.set()

    def _failed(self, event: mqtt5.LifecycleConnectFailureData) -> None:
        code = event.connack_packet.reason_code.name if event.connack_packet else ""
        self._failure = code or str(event.exception)
        self._tried.set()

    def _heard(self, event: mqtt5.PublishReceivedData) -> None:
        packet = event.publish_packet
        try:
            self._on_message(packet.topic, bytes(packet.payload or b""))
        except Exception:  # noqa: BLE001 - logged
            # The client's thread must go on.
            _log.exception("a message on %s could not be taken", packet.topic)
