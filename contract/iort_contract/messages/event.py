"""A topic rule's event for a function: the message's bytes, and the cloud's own keys."""

from __future__ import annotations

import base64
from typing import Any, Mapping

from iort_contract.checks import shown
from iort_contract.limits import ContractError
from iort_contract.tables import MESSAGE_BASE64, RECEIVED_MS, TOPIC


def rule_event(message: bytes, topic: str, received_ms: int) -> dict[str, Any]:
    """The event that the rules live, echo and upload make of a message."""
    return {MESSAGE_BASE64: base64.b64encode(message).decode(), TOPIC: topic, RECEIVED_MS: received_ms}


def event_message(event: Mapping[str, Any]) -> bytes:
    """The message of a `rule_event` as it was sent; raises `ContractError` for another kind of event."""
    encoded = event.get(MESSAGE_BASE64)
    if not isinstance(encoded, str):
        raise ContractError(f"{MESSAGE_BASE64} must be text, got {shown(encoded)}")
    try:
        return base64.b64decode(encoded, validate=True)
    except ValueError as error:
        raise ContractError(f"{MESSAGE_BASE64} must be base64") from error
