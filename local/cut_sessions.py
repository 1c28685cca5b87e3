"""A gap of its own: sessions that AWS would not let live. The emulator keeps one whose certificate is no
longer active (AWS ends it within minutes), does not know DeleteConnection, and serves a client that
shows no certificate at all, as its own account and without policies.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import wraps
from typing import Any
from urllib.parse import unquote

from ministack.core.responses import error_response_json, get_account_id, get_region
from ministack.services import iot, iot_data

# MQTT 5, "Disconnect Reason Code values".
_NOT_AUTHORIZED, _ADMINISTRATIVE_ACTION = 0x87, 0x98


def install() -> None:
    """Close the gap in this process, before the emulator starts."""
    iot.handle_request = _ending_with_the_certificate(iot.handle_request)
    iot_data.handle_request = _with_delete_connection(iot_data.handle_request)
    iot._mtls_serve_conn = _for_a_certificate(iot._mtls_serve_conn)


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
                        await _cut(session, "AUTH_ERROR", _NOT_AUTHORIZED)
        return answer

    return handle_request


def _with_delete_connection(handle: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(handle)
    async def handle_request(method: str, path: str, headers: Any, body: bytes, query: Any) -> Any:
        if method != "DELETE" or not path.startswith("/connections/"):
            return await handle(method, path, headers, body, query)
        client = unquote(path[len("/connections/") :])
        key = (get_account_id(), get_region(), client)
        session = iot._connected_clients.get(key)
        if session is None:
            return error_response_json("ResourceNotFoundException", f"Client {client} is not connected", 404)
        if _says(query, "preventWillMessage"):
            session._will_topic = None
        if _says(query, "cleanSession"):
            session._persist_session = False
        await _cut(session, "API_INITIATED_DISCONNECT", _ADMINISTRATIVE_ACTION)
        return 200, {"Content-Type": "application/json"}, b""

    return handle_request


def _for_a_certificate(serve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(serve)
    async def serve_connection(reader: Any, writer: Any) -> None:
        tls = writer.get_extra_info("ssl_object")
        if tls is None or not tls.getpeercert(binary_form=True):
            await iot._mtls_close(writer)
        else:
            await serve(reader, writer)

    return serve_connection


def _says(query: Any, name: str) -> bool:
    value = query.get(name)
    return str(value[0] if isinstance(value, list) else value).lower() == "true"


async def _cut(session: Any, reason: str, code: int) -> None:
    """End a session as the broker does when it is taken over, for another reason."""
    session._forced_disconnect_reason = reason
    # The client may be gone already.
    with contextlib.suppress(Exception):
        if session.protocol_version == iot.MQTT_5:
            await session.send_bytes(iot._make_disconnect(code))
        await session._send({"type": "websocket.close", "code": 1000})
    await session.cleanup()
