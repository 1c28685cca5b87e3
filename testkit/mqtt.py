"""Bare MQTT 5 clients, a robot's and a person's, that report the broker's answers."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import yaml
from awscrt import auth, mqtt5
from awsiot import mqtt5_client_builder
from botocore.credentials import ReadOnlyCredentials
from typing_extensions import Self

from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import LIVE
from iort_station.cloud import Cloud
from testkit.waiting import InstrumentError, until

WAIT_S = 60.0
# AWS accepts one CONNECT a second per client id ("Connect requests per second per client ID").
CONNECT_AGAIN_S = 1.2
# A live message that Lambda 1 drops: a refused one would be kept, and cost the robot its allowance.
STALE = encode_live(LiveSample("0" * 8, 0, 0, 0, {}, offset_us=0))


def payload_for(topic: str) -> bytes:
    """A payload for any topic where the content does not matter."""
    return STALE if f"{LIVE}/" in topic else b"{}"


class Client:
    """A client of the broker, by its name for errors.

    ``build`` makes the library's client from the options that all have. `reason` is the name of the reason
    code with which the broker refused or ended the connection; "" if it gave none. ``take`` gets each message
    in the client's thread; without it they wait for `next_message`.
    """

    def __init__(
        self, name: str, build: Callable[..., mqtt5.Client], take: Callable[[str, bytes], None] | None = None
    ) -> None:
        self.name = name
        self.messages: queue.Queue[tuple[str, bytes]] = queue.Queue()
        put = take or (lambda topic, payload: self.messages.put((topic, payload)))
        self.connected, self.refused, self.lost = threading.Event(), threading.Event(), threading.Event()
        self.reason = ""
        self._stopped = threading.Event()
        self._client = build(
            ack_timeout_sec=60,
            min_reconnect_delay_ms=60_000,
            max_reconnect_delay_ms=60_000,
            on_publish_received=lambda data: put(data.publish_packet.topic, data.publish_packet.payload),
            on_lifecycle_connection_success=lambda _data: self.connected.set(),
            on_lifecycle_connection_failure=lambda data: self._ended(data.connack_packet, self.refused),
            on_lifecycle_disconnection=lambda data: self._ended(data.disconnect_packet, self.lost),
            on_lifecycle_stopped=lambda _data: self._stopped.set(),
        )

    def __enter__(self) -> Self:
        self._client.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._client.stop()
        if not self._stopped.wait(WAIT_S):
            raise InstrumentError(f"{self.name}: the client did not stop")

    def online(self) -> Self:
        """Wait until the broker has accepted the connection; raises `InstrumentError` if it does not."""
        if not self.connected.wait(WAIT_S):
            raise InstrumentError(f"{self.name}: the broker did not accept the connection")
        return self

    def publish(self, topic: str, payload: bytes) -> str:
        """Publish at QoS 1; return the broker's reason code. Raises `InstrumentError` if none comes."""
        answer = self._answer(self.send(topic, payload))
        return str(answer.puback.reason_code.name)

    def send(self, topic: str, payload: bytes) -> Future[Any]:
        """Publish at QoS 1 without waiting; return the library's future."""
        packet = mqtt5.PublishPacket(topic=topic, payload=payload, qos=mqtt5.QoS.AT_LEAST_ONCE)
        published: Future[Any] = self._client.publish(packet)
        return published

    def attempt(self, topic: str, payload: bytes) -> str:
        """Publish at QoS 1; return the broker's reason code, "DISCONNECTED" if it ends the session, or
        "NOT_SENT" if the library rejects what the broker would refuse."""
        sent = self.send(topic, payload)
        until(lambda: sent.done() or self.lost.is_set(), f"an answer to a message on {topic}")
        if sent.done() and not sent.exception():
            return str(sent.result().puback.reason_code.name)
        return "DISCONNECTED" if self.lost.is_set() else "NOT_SENT"

    def subscribe(self, topic_filter: str, qos: int = 1) -> str:
        """Subscribe; return the broker's reason code. Raises `InstrumentError` if none comes."""
        subscription = mqtt5.Subscription(topic_filter=topic_filter, qos=mqtt5.QoS(qos))
        packet = mqtt5.SubscribePacket(subscriptions=[subscription])
        answer = self._answer(self._client.subscribe(packet))
        return str(answer.reason_codes[0].name)

    def next_message(self, within_s: float = WAIT_S) -> tuple[str, bytes]:
        """The next incoming message. Raises `InstrumentError` if none comes in time."""
        try:
            return self.messages.get(timeout=within_s)
        except queue.Empty:
            raise InstrumentError(f"{self.name}: no message within {within_s:g} s") from None

    def _answer(self, asked: Future[Any]) -> Any:
        try:
            return asked.result(WAIT_S)
        except Exception as error:  # AwsCrtError, CancelledError, TimeoutError and others
            raise InstrumentError(f"{self.name}: the broker did not answer: {error!r}") from error

    def _ended(self, packet: Any, what: threading.Event) -> None:
        if packet is not None:
            self.reason = str(packet.reason_code.name)
        what.set()


class Robot(Client):
    """Connects as `name`, or as another client id, with the bundle of a registered robot.

    With ``paced``, the library respects AWS' quotas of a connection.
    """

    def __init__(self, folder: Path, *, client_id: str | None = None, paced: bool = True) -> None:
        config: dict[str, Any] = yaml.safe_load((folder / "car.yaml").read_text())
        flow = mqtt5.ExtendedValidationAndFlowControlOptions
        super().__init__(
            config["robot"],
            partial(
                mqtt5_client_builder.mtls_from_path,
                str(folder / "certificate.pem"),
                str(folder / "private.key"),
                endpoint=config["endpoint"],
                port=config["port"],
                # AWS' own root is in the system's store.
                ca_filepath=str(folder / config["root_ca"]) if "root_ca" in config else None,
                client_id=client_id or config["robot"],
                extended_validation_and_flow_control_options=(
                    flow.AWS_IOT_CORE_DEFAULTS if paced else flow.NONE
                ),
            ),
        )


class Person(Client):
    """Connects over a signed WebSocket, as a page does, with these credentials of an IAM role."""

    def __init__(self, cloud: Cloud, credentials: ReadOnlyCredentials, client_id: str) -> None:
        gateway = urlsplit(cloud.endpoint_url or "")
        where = (
            {"endpoint": gateway.hostname, "port": gateway.port, "ca_filepath": cloud.ca_bundle}
            if gateway.hostname
            else {"endpoint": cloud.mqtt_endpoint}
        )
        keys = (credentials.access_key, credentials.secret_key, credentials.token)
        super().__init__(
            client_id,
            partial(
                mqtt5_client_builder.websockets_with_default_aws_signing,
                cloud.region_name or "",
                auth.AwsCredentialsProvider.new_static(*keys),
                **where,
                client_id=client_id,
            ),
        )


def refusal(folder: Path, *, client_id: str | None = None) -> str | None:
    """The name of the code with which a connection is refused, "" without a code; None if it is accepted."""
    with Robot(folder, client_id=client_id) as robot:
        until(lambda: robot.connected.is_set() or robot.refused.is_set(), "the broker's answer to a CONNECT")
        return None if robot.connected.is_set() else robot.reason


def soon_refused(folder: Path) -> str | None:
    """Like `refusal`, if the broker may need some seconds to know."""

    def refused() -> list[str]:
        time.sleep(CONNECT_AGAIN_S)
        code = refusal(folder)
        return [] if code is None else [code]

    try:
        return until(refused, "a refusal of the certificate", within_s=50)[0]
    except InstrumentError:
        return None
