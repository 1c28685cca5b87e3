"""Subscribes at a broker and measures the delay of messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from bench.errors import BenchError
from iort_agent.mqtt.uplink import matches
from iort_contract.messages.live import decode_live

NAME = "bench-watcher"
_WAIT_S = 20.0
TimeOf = Callable[[bytes], int]


def live_us(payload: bytes) -> int:
    """Return the time of a live message's sample, in microseconds."""
    return decode_live(payload).t_us


@contextmanager
def listening(
    *, endpoint: str, port: int, certificate: Path, key: Path, ca: Path, took_us: Mapping[str, TimeOf]
) -> Iterator[dict[str, list[float]]]:
    """Collect the delay in ms of every message, by topic filter.

    ``took_us`` has a function for each topic filter that reads from a message when it was sent.
    """
    heard: dict[str, list[float]] = {topic_filter: [] for topic_filter in took_us}

    def take(topic: str, payload: bytes) -> None:
        now_us = time.time_ns() // 1000
        for topic_filter, began_us in took_us.items():
            if matches(topic_filter, topic):
                heard[topic_filter].append((now_us - began_us(payload)) / 1000)

    with subscribed((endpoint, port), (certificate, key, ca), list(took_us), take):
        yield heard


@contextmanager
def subscribed(
    address: tuple[str, int],
    files: tuple[Path, Path, Path],
    topic_filters: Sequence[str],
    take: Callable[[str, bytes], None],
    *,
    qos: mqtt5.QoS = mqtt5.QoS.AT_MOST_ONCE,
) -> Iterator[None]:
    """Call ``take`` with topic and payload of every message, in the client's thread.

    ``files`` are the certificate, its key and the authority's certificate.
    """
    connected, stopped = threading.Event(), threading.Event()
    certificate, key, ca = files
    endpoint, port = address
    client = mqtt5_client_builder.mtls_from_path(
        str(certificate),
        str(key),
        endpoint=endpoint,
        port=port,
        ca_filepath=str(ca),
        client_id=NAME,
        on_publish_received=lambda data: take(data.publish_packet.topic, data.publish_packet.payload),
        on_lifecycle_connection_success=lambda _: connected.set(),
        on_lifecycle_stopped=lambda _: stopped.set(),
    )
    client.start()
    if not connected.wait(_WAIT_S):
        raise BenchError(f"{NAME} was not connected within {_WAIT_S:.0f} s")
    wanted = [mqtt5.Subscription(topic_filter=topic_filter, qos=qos) for topic_filter in topic_filters]
    client.subscribe(mqtt5.SubscribePacket(subscriptions=wanted)).result(_WAIT_S)
    try:
        yield
    finally:
        client.stop()
        stopped.wait(_WAIT_S)
