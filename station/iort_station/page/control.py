"""What the page may have its server do with a robot: send one command, as `iort send`."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping

from iort_contract.messages.commands import MAX_LEASE_MS
from iort_contract.messages.page import SendAnswer
from iort_contract.topics import ACCEPTED
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import commands
from iort_station.page.answers import text, whole
from iort_station.page.server import Answer


def actions(cloud: Cloud) -> dict[str, Answer]:
    """Every action that moves or changes a robot, by its name; only for a server on loopback."""
    return {"send": lambda asked: send(cloud, asked)}


def send(cloud: Cloud, asked: Mapping[str, str]) -> SendAnswer:
    """Send the ``command`` of this name with its ``message`` to ``robot``, for ``lease_ms`` if it moves."""
    try:
        message = json.loads(text(asked, "message"))
    except ValueError as error:
        raise StationError(f"the message must be JSON: {error}") from error
    if not isinstance(message, dict):
        raise StationError("the message must be a JSON object with the fields of the ROS message")
    lease_ms = whole(asked, "lease_ms", 1, MAX_LEASE_MS) if asked.get("lease_ms") else None
    began = time.monotonic()
    sent = commands.send(cloud, text(asked, "robot"), text(asked, "command"), message, lease_ms=lease_ms)
    after_ms = round((time.monotonic() - began) * 1000)
    if sent.outcome is None:
        return {"accepted": None, "reason": "", "after_ms": after_ms}
    accepted = sent.outcome == ACCEPTED
    return {"accepted": accepted, "reason": "" if accepted else sent.outcome, "after_ms": after_ms}
