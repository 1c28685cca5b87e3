"""A message as a topic rule hands it to a function: its own bytes, beside what only the cloud can say."""

from __future__ import annotations

import base64
from typing import Any, Mapping

from iort_contract.checks import shown
from iort_contract.limits import ContractError
from iort_contract.tables import RECEIVED_MS, TOPIC

# As one opaque value, whatever it is: no key of the message's can stand where the cloud's own stands.
MESSAGE_BASE64 = "message_base64"


def rule_event(message: bytes, topic: str, received_ms: int) -> dict[str, Any]:
    """What the rules live, echo and upload make of a message, and their functions are called with."""
    return {MESSAGE_BASE64: base64.b64encode(message).decode(), TOPIC: topic, RECEIVED_MS: received_ms}


def event_message(event: Mapping[str, Any]) -> bytes:
    """The message that a `rule_event` was made of, as it was sent; raises `ContractError` for an event of
    another kind."""
    encoded = event.get(MESSAGE_BASE64)
    if not isinstance(encoded, str):
        raise ContractError(f"{MESSAGE_BASE64}: expected text, not {shown(encoded)}")
    try:
        return base64.b64decode(encoded, validate=True)
    except ValueError as error:
        raise ContractError(f"{MESSAGE_BASE64}: no base64") from error
