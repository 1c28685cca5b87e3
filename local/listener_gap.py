"""A gap of its own: where the MQTT listener listens, and for how long without a CONNECT. The emulator's takes
every address of the machine, whatever its other listener takes, and leaves a connection open for ever whose
client never says who it is.

AWS says nowhere how long it waits for a CONNECT. That a server closes such a connection after a reasonable
time is the standard's: MQTT 3.1.1, section 3.1.4, and MQTT 5, section 3.1.4.
"""

from __future__ import annotations

import asyncio
import contextvars
import os
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot

# From the connection on, its TLS handshake included: more than many robots take that all begin at once.
CONNECT_S = 30.0
_deadline: contextvars.ContextVar[asyncio.TimerHandle] = contextvars.ContextVar("deadline")


def install() -> None:
    """Close the gap in this process, before the emulator starts."""
    iot._mtls_start_locked = _listen
    iot._MtlsAcceptor.connection_made = expecting_connect(iot._MtlsAcceptor.connection_made, CONNECT_S)
    iot._register_client = _in_time(iot._register_client)


async def _listen() -> None:
    """Listen where the gateway does."""
    port = iot._mtls_port()
    if iot._mtls_server is not None or port is None:
        return
    loop = asyncio.get_running_loop()
    iot._mtls_server = await loop.create_server(iot._MtlsAcceptor, host=os.environ["BIND_HOST"], port=port)
    iot._mtls_loop = loop


def expecting_connect(connection_made: Callable[..., None], seconds: float) -> Callable[..., None]:
    """An acceptor's `connection_made` that ends a connection without a session after so long."""

    @wraps(connection_made)
    def made(self: Any, transport: Any) -> None:
        loop = asyncio.get_running_loop()
        # What serves the connection has a copy of this context.
        context = contextvars.copy_context()
        context.run(_deadline.set, loop.call_later(seconds, transport.abort))
        # Up to Python 3.10 the loop starts to read after this call, whether or not it was paused here.
        loop.call_soon(connection_made, self, transport, context=context)

    return made


def _in_time(register: Callable[..., None]) -> Callable[..., None]:
    @wraps(register)
    def register_client(*arguments: Any) -> None:
        # A client that comes by HTTP's port has no deadline.
        deadline = _deadline.get(None)
        if deadline is not None:
            deadline.cancel()
        register(*arguments)

    return register_client
