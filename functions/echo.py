"""Echo: answers a ping through Lambda."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from functions.shared import clients
from functions.shared.metrics import emit
from functions.shared.queues import quarantined
from iort_contract.checks import json_object
from iort_contract.messages.envelope import event_message
from iort_contract.tables import PING_FIELDS, RECEIVED_MS, TOPIC
from iort_contract.topics import LAMBDA, PONG, build_topic, parse_topic


def pong(event: Mapping[str, Any]) -> tuple[str, bytes]:
    """The answer's topic and payload: the ping's fields and the cloud's ``received_ms``.

    Raises `ContractError` for a topic outside the contract, or a message that is not a ping.
    """
    topic = parse_topic(event[TOPIC])
    ping = json_object(event_message(event), "ping")
    content = {name: ping[name] for name in PING_FIELDS if name in ping}
    answer = json.dumps({**content, RECEIVED_MS: event[RECEIVED_MS]}, separators=(",", ":"))
    return build_topic(PONG, topic.robot, LAMBDA, topic.namespace), answer.encode()


@quarantined
def handler(event: Mapping[str, Any]) -> None:
    """Entry point of the echo rule's Lambda action."""
    topic, payload = pong(event)
    clients.iot_data().publish(topic=topic, qos=0, payload=payload)
    emit("echo", PongsSent=1)
