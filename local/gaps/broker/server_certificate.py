"""The broker's certificate is the operator's, and is renewed while it runs.

AWS: does not apply; its endpoint has AWS' own certificate. One for a custom domain the operator renews
  (https://docs.aws.amazon.com/iot/latest/developerguide/iot-custom-endpoints-configurable-custom.html).
ministack: issues one by itself for loopback and one name, good for 825 days, and reads it once.
Test: tests/local/gaps/test_listener_gap.py::test_the_broker_takes_over_a_renewed_certificate
Patch: none; the file is in an environment variable, and upstream would want an API like AWS' own
"""

from __future__ import annotations

import inspect
import os
import ssl
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path

from ministack.services import iot

# The file with the private key, the certificate and its authority's.
VARIABLE = "IORT_BROKER_CERTIFICATE"


def install() -> None:
    """Close the gap in this process, if there is a certificate."""
    if os.environ.get(VARIABLE):
        file = Path(os.environ[VARIABLE])
        iot._mtls_ensure_server_cert = lambda: (file.read_text(), "")
        iot._mtls_context = _following(iot._mtls_context, file)


def is_open() -> bool:
    """Ask whether a certificate of one's own can be named."""
    return "environ" not in inspect.getsource(iot._mtls_ensure_server_cert)


def _following(
    made: Callable[[], Awaitable[ssl.SSLContext | None]], file: Path
) -> Callable[[], Awaitable[ssl.SSLContext | None]]:
    loaded: dict[ssl.SSLContext, int] = {}

    @wraps(made)
    async def context() -> ssl.SSLContext | None:
        now = os.stat(file).st_mtime_ns  # noqa: PTH116 - asyncio's rule knows Path alone, and this takes microseconds
        found = await made()
        if found is not None and loaded.setdefault(found, now) != now:
            # A file that cannot be read keeps the certificate that is there.
            with suppress(OSError):
                found.load_cert_chain(file)
                loaded[found] = now
        return found

    return context
