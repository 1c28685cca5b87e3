"""Listens to a robot's live topic at the broker, with a certificate made for it."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from contract import LIVE, decode_live
from station.cloud import Cloud

NAME = "bench-watcher"
_WAIT_S = 20.0


@contextmanager
def delays_ms(cloud: Cloud, folder: Path, robot: str) -> Iterator[list[float]]:
    """From a sample's own time to its arrival at an MQTT subscriber, of every live message meanwhile."""
    iot = cloud.client("iot")
    document = {
        "Statement": [{"Effect": "Allow", "Action": "iot:*", "Resource": "*"}],
        "Version": "2012-10-17",
    }
    iot.create_policy(policyName=NAME, policyDocument=json.dumps(document))
    created = iot.create_keys_and_certificate(setAsActive=True)
    iot.attach_policy(policyName=NAME, target=created["certificateArn"])
    files = {
        "certificate": created["certificatePem"],
        "key": created["keyPair"]["PrivateKey"],
        "ca": cloud.root_ca_pem,
    }
    for name, text in files.items():
        (folder / name).write_text(text or "")
    heard: list[float] = []
    connected, stopped = threading.Event(), threading.Event()

    def take(data: mqtt5.PublishReceivedData) -> None:
        now_us = time.time_ns() // 1000
        heard.append((now_us - decode_live(data.publish_packet.payload).t_us) / 1000)

    client = mqtt5_client_builder.mtls_from_path(
        str(folder / "certificate"),
        str(folder / "key"),
        endpoint=cloud.mqtt_endpoint,
        port=cloud.mqtt_port,
        ca_filepath=str(folder / "ca"),
        client_id=NAME,
        on_publish_received=take,
        on_lifecycle_connection_success=lambda _: connected.set(),
        on_lifecycle_stopped=lambda _: stopped.set(),
    )
    client.start()
    if not connected.wait(_WAIT_S):
        raise TimeoutError(f"{NAME} was not connected within {_WAIT_S:.0f} s")
    wanted = mqtt5.Subscription(
        topic_filter=f"{LIVE}/{cloud.namespace}/{robot}/+", qos=mqtt5.QoS.AT_MOST_ONCE
    )
    client.subscribe(mqtt5.SubscribePacket(subscriptions=[wanted])).result(_WAIT_S)
    try:
        yield heard
    finally:
        client.stop()
        stopped.wait(_WAIT_S)
        certificate = created["certificateId"]
        iot.detach_policy(policyName=NAME, target=created["certificateArn"])
        iot.update_certificate(certificateId=certificate, newStatus="INACTIVE")
        iot.delete_certificate(certificateId=certificate, forceDelete=True)
        iot.delete_policy(policyName=NAME)
