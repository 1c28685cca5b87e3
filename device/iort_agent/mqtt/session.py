"""One connection to the broker that does not come back, for the verbs: it says why it failed."""

from __future__ import annotations

import queue
import threading
import time
from pathlib import Path
from typing import Any

from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from iort_agent.mqtt.failures import code_name, explain, said

# So late that this connection does not come back.
_NEVER_MS = 60_000


class RefusalError(Exception):
    """The broker has answered, and its answer is no."""


class Session:
    """A session of a client, which ends with its connection."""

    def __init__(
        self,
        client_id: str,
        certificate: bytes,
        private_key: bytes,
        *,
        endpoint: str,
        port: int,
        root_ca: Path | None,
    ) -> None:
        self._ended, self._stopped = threading.Event(), threading.Event()
        self._connected = False
        self._messages: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        # Why the broker did not accept; what it said, if it answered; the client's error, if it did not.
        self.failure, self.refusal, self.error = "no answer", "", ""
        # Why the connection ended before `close`, such as another client with this name.
        self.lost = ""
        self.client: Any = mqtt5_client_builder.mtls_from_bytes(
            certificate,
            private_key,
            endpoint=endpoint,
            port=port,
            ca_filepath=None if root_ca is None else str(root_ca),
            client_id=client_id,
            session_behavior=mqtt5.ClientSessionBehaviorType.CLEAN,
            min_reconnect_delay_ms=_NEVER_MS,
            max_reconnect_delay_ms=_NEVER_MS,
            on_publish_received=self._on_publish,
            on_lifecycle_connection_success=self._on_success,
            on_lifecycle_connection_failure=self._on_failure,
            on_lifecycle_disconnection=self._on_disconnection,
            on_lifecycle_stopped=lambda _: self._stopped.set(),
        )

    def open(self, timeout_s: float) -> bool:
        """Connect; whether the broker accepted."""
        self.client.start()
        return self._ended.wait(timeout_s) and self._connected

    def close(self, timeout_s: float = 30.0) -> None:
        """Disconnect, or give up connecting."""
        self.client.stop()
        self._stopped.wait(timeout_s)

    def subscribe(self, topic: str, timeout_s: float) -> None:
        """Subscribe to a topic. Raises `RefusalError`, and what the client raises without an answer."""
        packet = mqtt5.SubscribePacket([mqtt5.Subscription(topic, mqtt5.QoS.AT_LEAST_ONCE)])
        (code,) = self.client.subscribe(packet).result(timeout_s).reason_codes
        if code >= mqtt5.SubackReasonCode.UNSPECIFIED_ERROR:
            raise RefusalError(code_name(code))

    def round_trip(self, topic: str, payload: bytes, answer_topic: str, timeout_s: float) -> bytes | None:
        """Publish a message, and return the next one on a topic; None without one in time. Raises
        `RefusalError` if the connection ends meanwhile."""
        until = time.monotonic() + timeout_s
        self.client.publish(mqtt5.PublishPacket(topic=topic, payload=payload, qos=mqtt5.QoS.AT_MOST_ONCE))
        while (left_s := until - time.monotonic()) > 0:
            try:
                answered, answer = self._messages.get(timeout=left_s)
            except queue.Empty:
                break
            if self.lost:
                raise RefusalError(self.lost)
            if answered == answer_topic:
                return answer
        return None

    def _on_publish(self, data: Any) -> None:
        packet = data.publish_packet
        self._messages.put((packet.topic, bytes(packet.payload or b"")))

    def _on_disconnection(self, data: Any) -> None:
        packet = data.disconnect_packet
        self.lost = said(packet) if packet is not None else explain(data.exception)
        self._messages.put(("", b""))  # ends a wait for an answer

    def _on_success(self, _: Any) -> None:
        self._connected = True
        self._ended.set()

    def _on_failure(self, data: Any) -> None:
        packet = data.connack_packet
        self.failure = said(packet) if packet is not None else explain(data.exception)
        if packet is not None:
            self.refusal = code_name(packet.reason_code)
        else:
            self.error = str(getattr(data.exception, "name", data.exception))
        self._ended.set()
