"""A message that fakes the cloud's keys: every key that a rule adds, in another robot's name."""

from __future__ import annotations

import base64
import json

from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.tables import AGENT_VERSION, EXPIRES_S, MESSAGE_BASE64, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import build_topic

# Times that the cloud never sends: of 1970, and of the year 2286.
LONG_AGO_MS, FAR_AHEAD_S = 7, 10**10


def spoofed(message: bytes, victim: str, lane: str, name: str, namespace: str = DEFAULT_NAMESPACE) -> bytes:
    """The message with every such key, first and last (a JSON reader may take either)."""
    keys = {
        TOPIC: build_topic(lane, victim, name, namespace),
        RECEIVED_MS: LONG_AGO_MS,
        EXPIRES_S: FAR_AHEAD_S,
        ROBOT: victim,
        MESSAGE_BASE64: base64.b64encode(b'{"v": 1}').decode(),
        AGENT_VERSION: "spoofed",
        "clientId": victim,
        "eventType": "disconnected",
        "unknown": "not stored",
    }
    members = json.dumps(keys)[1:-1]
    return f"{{{members}, {message.decode().strip()[1:-1]}, {members}}}".encode()
