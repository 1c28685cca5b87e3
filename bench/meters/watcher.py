"""Subscribes at a broker, and hands over every message."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from bench.floors.mosquitto import HOST, Mosquitto
from testkit.waiting import InstrumentError

NAME = "bench-watcher"
_WAIT_S = 20.0


@contextmanager
def subscribed(
    broker: Mosquitto, topic_filters: Sequence[str], take: Callable[[str, bytes], None], *, qos: int = 0
) -> Iterator[None]:
    """Call ``take`` with topic and payload of every message, in the client's thread."""
    connected, stopped = threading.Event(), threading.Event()
    certificate, key = broker.identity("watcher")
    client = mqtt5_client_builder.mtls_from_path(
        str(certificate),
        str(key),
        endpoint=HOST,
        port=broker.port,
        ca_filepath=str(broker.ca),
        client_id=NAME,
        on_publish_received=lambda data: take(data.publish_packet.topic, data.publish_packet.payload),
        on_lifecycle_connection_success=lambda _: connected.set(),
        on_lifecycle_stopped=lambda _: stopped.set(),
    )
    client.start()
    if not connected.wait(_WAIT_S):
        raise InstrumentError(f"{NAME} was not connected within {_WAIT_S:.0f} s")
    wanted = [mqtt5.Subscription(topic_filter=each, qos=mqtt5.QoS(qos)) for each in topic_filters]
    client.subscribe(mqtt5.SubscribePacket(subscriptions=wanted)).result(_WAIT_S)
    try:
        yield
    finally:
        client.stop()
        stopped.wait(_WAIT_S)
