"""A connection without a CONNECT ends.

AWS: names no time. The standard says that a server closes such a connection after a reasonable time
  (https://docs.oasis-open.org/mqtt/mqtt/v3.1.1/os/mqtt-v3.1.1-os.html, section 3.1.4).
ministack: keeps it open for ever.
Test: tests/local/test_listener_gap.py::test_a_connection_that_never_says_who_it_is_ends
Patch: local/patches/connect_timeout.patch
"""

from __future__ import annotations

import asyncio
import contextvars
import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot

# From the connection on, with the TLS handshake: longer than many robots take that connect at once.
CONNECT_S = 30.0
_deadline: contextvars.ContextVar[asyncio.TimerHandle] = contextvars.ContextVar("deadline")


def install() -> None:
    """Close the gap in this process."""
    iot._MtlsAcceptor.connection_made = expecting_connect(iot._MtlsAcceptor.connection_made, CONNECT_S)
    iot._register_client = in_time(iot._register_client)


def is_open() -> bool:
    """Look at the source for a time limit: no finite wait shows that a connection would stay for ever."""
    source = inspect.getsource(iot._mtls_serve_conn) + inspect.getsource(iot._MtlsAcceptor)
    return "timeout" not in source and "wait_for" not in source


def expecting_connect(connection_made: Callable[..., None], seconds: float) -> Callable[..., None]:
    """An acceptor's `connection_made` that ends a connection without a session after so long."""

    @wraps(connection_made)
    def made(self: Any, transport: Any) -> None:
        loop = asyncio.get_running_loop()
        # The task that serves the connection copies this context.
        context = contextvars.copy_context()
        context.run(_deadline.set, loop.call_later(seconds, transport.abort))
        context.run(connection_made, self, transport)

    return made


def in_time(register: Callable[..., None]) -> Callable[..., None]:
    """A registration of a client that cancels the deadline of its connection."""

    @wraps(register)
    def register_client(*arguments: Any) -> None:
        # A client on the HTTPS port has no deadline.
        deadline = _deadline.get(None)
        if deadline is not None:
            deadline.cancel()
        register(*arguments)

    return register_client
