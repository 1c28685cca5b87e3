"""Ends a session of ministack's broker as the broker itself does when another client takes it over."""

from __future__ import annotations

import contextlib
from typing import Any

from ministack.services import iot


async def end_session(session: Any, reason: str, code: int) -> None:
    """End a session: ``reason`` is for the presence event, ``code`` for an MQTT 5 client."""
    session._forced_disconnect_reason = reason
    # The client may be gone already.
    with contextlib.suppress(Exception):
        if session.protocol_version == iot.MQTT_5:
            await session.send_bytes(iot._make_disconnect(code))
        await session._send({"type": "websocket.close", "code": 1000})
    await session.cleanup()
