"""A session ends with its certificate.

AWS: ends the session of a certificate that is deactivated, revoked or deleted, within minutes
  (https://docs.aws.amazon.com/iot/latest/developerguide/device-certs-create.html).
ministack: keeps the session until the client leaves.
Test: tests/local/test_fleet.py::test_a_session_ends_with_its_certificate
Patch: local/patches/certificate_status.patch
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.core.responses import request_scope
from ministack.services import iot

from local.gaps.parts.sessions import end_session

# MQTT 5, "Disconnect Reason Code values".
_NOT_AUTHORIZED = 0x87


def install() -> None:
    """Close the gap in this process."""
    iot.handle_request = _ending_with_the_certificate(iot.handle_request)


def is_open() -> bool:
    """Deactivate the certificate of a session, and look whether the session is still there."""
    account, region, number = "000000000000", "eu-west-1", "gaps-certificate-status"

    async def run() -> bool:
        async def send(_message: dict[str, Any]) -> None:
            pass

        session = iot._WSSession(send, account, region, number)
        session.certificate_id = number
        session._client_id = number
        iot._certificates[number] = iot._certificate_record(number, "", "ACTIVE")
        iot._register_client(account, region, number, session)
        await iot.handle_request("PUT", f"/certificates/{number}", {}, b'{"newStatus": "INACTIVE"}', {})
        return iot._connected_clients.pop((account, region, number), None) is not None

    with request_scope(account, region):
        try:
            return asyncio.run(run())
        finally:
            iot._certificates.pop(number, None)


def _ending_with_the_certificate(handle: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(handle)
    async def handle_request(method: str, path: str, *rest: Any) -> Any:
        answer = await handle(method, path, *rest)
        if method in {"PUT", "DELETE"} and path.startswith("/certificates/"):
            number = path.rsplit("/", 1)[-1]
            record = iot._certificates.get(number)
            if record is None or record["status"] != "ACTIVE":
                for session in list(iot._connected_clients.values()):
                    if session.certificate_id == number:
                        await end_session(session, "AUTH_ERROR", _NOT_AUTHORIZED)
        return answer

    return handle_request
