"""The maximum size of a message.

AWS: refuses a payload above 128 KB and ends the session
  (https://docs.aws.amazon.com/general/latest/gr/iot-core.html).
ministack: takes it from an MQTT 3.1.1 client and by HTTP.
Test: tests/local/test_gaps.py::test_large_publish_is_refused_before_anything_happens
Patch: local/patches/message_size.patch
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot

AWS_MESSAGE_BYTES = 128 * 1024


class MessageTooLargeError(ConnectionError):
    """A publish above AWS IoT Core's message size; as a connection error it ends the session."""


def install() -> None:
    """Close the gap in this process."""
    iot.broker_publish = refusing_large(iot.broker_publish)


def is_open() -> bool:
    """Publish one byte too many, to nobody."""
    payload = b"x" * (AWS_MESSAGE_BYTES + 1)
    try:
        asyncio.run(iot.broker_publish("000000000000", "eu-west-1", "gaps/message_size", payload))
    except ConnectionError:
        return False
    return True


def refusing_large(publish: Callable[..., Any]) -> Callable[..., Any]:
    """A publish that raises `MessageTooLargeError` before it does anything."""

    @wraps(publish)
    async def broker_publish(account: str, region: str, topic: str, payload: bytes, **rest: Any) -> None:
        if len(payload) > AWS_MESSAGE_BYTES:
            raise MessageTooLargeError(
                f"payload must be at most {AWS_MESSAGE_BYTES} bytes, got {len(payload)}"
            )
        await publish(account, region, topic, payload, **rest)

    return broker_publish
