"""A bare MQTT 5 client with a robot's certificate, which says what the broker answers."""

from __future__ import annotations

import queue
import threading
from pathlib import Path
from typing import Any

import yaml
from awscrt import mqtt5
from awsiot import mqtt5_client_builder
from typing_extensions import Self

from contract import LIVE, LiveSample, encode_live
from verify.errors import VerifyError

WAIT_S = 60.0
# A live message that Lambda 1 drops: what it refuses is kept, and costs the robot its allowance.
STALE = encode_live(LiveSample("0" * 8, 0, 0, 0, {}, offset_us=0))


def payload_for(topic: str) -> bytes:
    """What may be published on any topic that does not matter to the test."""
    return STALE if f"{LIVE}/" in topic else b"{}"


class Robot:
    """Connects as `name`, or as another client id, with the bundle of a registered robot."""

    def __init__(self, folder: Path, *, client_id: str | None = None) -> None:
        config: dict[str, Any] = yaml.safe_load((folder / "car.yaml").read_text())
        self.name = config["robot"]
        self.messages: queue.Queue[tuple[str, bytes]] = queue.Queue()
        self.connected, self.refused, self.lost = threading.Event(), threading.Event(), threading.Event()
        self._stopped = threading.Event()
        self._client = mqtt5_client_builder.mtls_from_path(
            str(folder / "certificate.pem"),
            str(folder / "private.key"),
            endpoint=config["endpoint"],
            port=config["port"],
            # AWS' own root is in the system's store.
            ca_filepath=str(folder / config["root_ca"]) if "root_ca" in config else None,
            client_id=client_id or self.name,
            ack_timeout_sec=60,
            min_reconnect_delay_ms=60_000,
            max_reconnect_delay_ms=60_000,
            on_publish_received=lambda data: self.messages.put(
                (data.publish_packet.topic, data.publish_packet.payload)
            ),
            on_lifecycle_connection_success=lambda _data: self.connected.set(),
            on_lifecycle_connection_failure=lambda _data: self.refused.set(),
            on_lifecycle_disconnection=lambda _data: self.lost.set(),
            on_lifecycle_stopped=lambda _data: self._stopped.set(),
        )

    def __enter__(self) -> Self:
        self._client.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._client.stop()
        if not self._stopped.wait(WAIT_S):
            raise VerifyError(f"{self.name}: the client did not stop")

    def online(self) -> Robot:
        """Wait until the broker has accepted the connection; raises `VerifyError` if it does not."""
        if not self.connected.wait(WAIT_S):
            raise VerifyError(f"{self.name}: the broker did not accept the connection")
        return self

    def publish(self, topic: str, payload: bytes) -> str:
        """Publish at QoS 1; the name of the broker's reason code."""
        packet = mqtt5.PublishPacket(topic=topic, payload=payload, qos=mqtt5.QoS.AT_LEAST_ONCE)
        answer = self._client.publish(packet).result(WAIT_S)
        return str(answer.puback.reason_code.name)

    def subscribe(self, topic_filter: str) -> str:
        """Subscribe at QoS 1; the name of the broker's reason code."""
        subscription = mqtt5.Subscription(topic_filter=topic_filter, qos=mqtt5.QoS.AT_LEAST_ONCE)
        answer = self._client.subscribe(mqtt5.SubscribePacket(subscriptions=[subscription])).result(WAIT_S)
        return str(answer.reason_codes[0].name)

    def next_message(self) -> tuple[str, bytes]:
        """The next message that comes in."""
        return self.messages.get(timeout=WAIT_S)
