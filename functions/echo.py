"""Echo: the answer to a ping that asks for the way through Lambda."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

import boto3

from contract import LAMBDA, PONG, TOPIC, build_topic, parse_topic
from functions.metrics import emit


def pong(event: Mapping[str, Any]) -> tuple[str, bytes]:
    """The topic and payload of the answer: the ping's content and the cloud's ``received_ms``.

    Raises `contract.ContractError` for a topic that is not one of ours.
    """
    ping = parse_topic(event[TOPIC])
    content = {key: value for key, value in event.items() if key != TOPIC}
    topic = build_topic(PONG, ping.robot, LAMBDA, ping.namespace)
    return topic, json.dumps(content, separators=(",", ":")).encode()


@cache
def _iot_data() -> Any:
    return boto3.client("iot-data")


def handler(event: dict[str, Any], _context: object) -> None:
    """Entry point of the echo rule's Lambda action."""
    topic, payload = pong(event)
    _iot_data().publish(topic=topic, qos=0, payload=payload)
    emit("echo", PongsSent=1)
