"""Echo: answers a ping through Lambda."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from typing import Any

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from functions.shared.queues import DeadLetterQueue, refused_event
from iort_contract.catalog.environments import EchoEnvironment
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import event_message
from iort_contract.tables import PING_FIELDS, RECEIVED_MS, TOPIC
from iort_contract.topics import LAMBDA, PONG, build_topic, parse_topic

_log = logging.getLogger(__name__)


def pong(event: Mapping[str, Any]) -> tuple[str, bytes]:
    """The answer's topic and payload: the ping's fields and the cloud's ``received_ms``.

    Raises `ContractError` for a topic outside the contract, or a message that is not a ping.
    """
    topic = parse_topic(event[TOPIC])
    ping = json_object(event_message(event), "ping")
    content = {name: ping[name] for name in PING_FIELDS if name in ping}
    answer = json.dumps({**content, RECEIVED_MS: event[RECEIVED_MS]}, separators=(",", ":"))
    return build_topic(PONG, topic.robot, LAMBDA, topic.namespace), answer.encode()


def serve(
    event: Mapping[str, Any],
    function_arn: str,
    *,
    publish: Callable[[str, bytes], None],
    keep: Callable[[str], bool],
) -> None:
    """Answer a ping by ``publish``. What is no ping goes to the quarantine's queue by ``keep``.

    The invocation does not fail then, so that the next ping finds this environment. Raises `ContractError` if
    the queue does not take it, so that Lambda sends it there.
    """
    try:
        topic, payload = pong(event)
    except ContractError as error:
        _log.warning("refused a ping: %s", error)
        if not keep(refused_event(function_arn, event, str(error))):
            raise
        return
    publish(topic, payload)
    emit("echo", PongsSent=1)


def _publish(topic: str, payload: bytes) -> None:
    clients.iot_data().publish(topic=topic, qos=0, payload=payload)


def handler(event: dict[str, Any], context: Any) -> None:
    """Entry point of the echo rule's Lambda action."""
    rejected = variables(EchoEnvironment).rejected_queue
    serve(
        event,
        context.invoked_function_arn,
        publish=_publish,
        keep=lambda body: DeadLetterQueue(clients.sqs(at_once=True), rejected).keep(body),
    )
