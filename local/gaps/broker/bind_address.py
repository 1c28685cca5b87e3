"""The MQTT listener listens where the gateway does.

AWS: does not apply; the embedded cloud must be reachable from this machine only.
ministack: listens for HTTPS on BIND_HOST, and for MQTT on every address of the machine.
Test: tests/local/test_listener_gap.py::test_every_listener_of_the_emulator_is_on_loopback
Patch: local/patches/bind_address.patch
"""

from __future__ import annotations

import asyncio
import os
from unittest.mock import patch

from ministack.services import iot


def install() -> None:
    """Close the gap in this process."""
    iot._mtls_start_locked = _listen


def is_open() -> bool:
    """Start the listener on a free port, and look at its address."""

    async def run() -> str:
        with patch.object(iot, "_mtls_port", lambda: 0), patch.dict(os.environ, BIND_HOST="127.0.0.1"):
            await iot._mtls_start_locked()
        server, iot._mtls_server, iot._mtls_loop = iot._mtls_server, None, None
        address = server.sockets[0].getsockname()[0]
        server.close()
        await server.wait_closed()
        return str(address)

    return asyncio.run(run()) != "127.0.0.1"


async def _listen() -> None:
    port = iot._mtls_port()
    if iot._mtls_server is not None or port is None:
        return
    loop = asyncio.get_running_loop()
    iot._mtls_server = await loop.create_server(iot._MtlsAcceptor, host=os.environ["BIND_HOST"], port=port)
    iot._mtls_loop = loop
