"""MQTT over TLS needs a client certificate.

AWS: authenticates a client on port 8883 by its certificate
  (https://docs.aws.amazon.com/iot/latest/developerguide/x509-client-certs.html).
ministack: serves a client without a certificate as its own account, without policies.
Test: tests/local/identity/test_isolation.py::test_a_client_without_a_certificate_cannot_connect
Patch: none; ministack serves such clients on purpose, so upstream would have to agree on a switch first
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot


def install() -> None:
    """Close the gap in this process."""
    iot._mtls_serve_conn = _for_a_certificate(iot._mtls_serve_conn)


def is_open() -> bool:
    """Ask who a client without a certificate is."""
    return iot._mtls_resolve_identity(None) is not None


def _for_a_certificate(serve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(serve)
    async def serve_connection(reader: Any, writer: Any) -> None:
        tls = writer.get_extra_info("ssl_object")
        if tls is None or not tls.getpeercert(binary_form=True):
            await iot._mtls_close(writer)
        else:
            await serve(reader, writer)

    return serve_connection
