"""The TLS handshake on Python 3.10.

AWS: does not apply; the embedded cloud must run on Python 3.10.
ministack: pauses reading in `connection_made`. Up to Python 3.10 the event loop starts to read after that
  call all the same, so the ClientHello is lost and the handshake is never answered.
Test: tests/local/test_listener_gap.py::test_a_session_outlives_the_wait_for_it
Patch: local/patches/client_hello.patch
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import wraps
from typing import Any
from unittest.mock import Mock, patch

from ministack.services import iot


def install() -> None:
    """Close the gap in this process."""
    iot._MtlsAcceptor.connection_made = later(iot._MtlsAcceptor.connection_made)


def is_open() -> bool:
    """Look whether reading is paused within `connection_made`; newer Pythons do not show the effect."""

    async def run() -> bool:
        transport = Mock()
        iot._MtlsAcceptor().connection_made(transport)
        paused = bool(transport.pause_reading.called)
        # Let what it has started come to its end.
        for _ in range(3):
            await asyncio.sleep(0)
        return paused

    async def no_context() -> None:
        return None

    with patch.object(iot, "_mtls_context", no_context):
        return asyncio.run(run())


def later(connection_made: Callable[..., None]) -> Callable[..., None]:
    """Call `connection_made` once the event loop has begun to read."""

    @wraps(connection_made)
    def made(self: Any, transport: Any) -> None:
        asyncio.get_running_loop().call_soon(connection_made, self, transport)

    return made
