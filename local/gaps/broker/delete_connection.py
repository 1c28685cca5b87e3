"""DeleteConnection ends a client's session.

AWS: has the operation in its data plane
  (https://docs.aws.amazon.com/iot/latest/apireference/API_iotdata_DeleteConnection.html).
ministack: answers that it does not support the path.
Test: tests/local/test_fleet.py::test_delete_connection_cuts_one_client_alone
Patch: local/patches/delete_connection.patch
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import wraps
from typing import Any
from urllib.parse import unquote

from ministack.core.responses import error_response_json, get_account_id, get_region
from ministack.services import iot, iot_data

from local.gaps.parts.sessions import end_session

# MQTT 5, "Disconnect Reason Code values".
_ADMINISTRATIVE_ACTION = 0x98


def install() -> None:
    """Close the gap in this process."""
    iot_data.handle_request = _with_delete_connection(iot_data.handle_request)


def is_open() -> bool:
    """Delete the connection of a client that is not connected: AWS answers 404."""
    answer = asyncio.run(iot_data.handle_request("DELETE", "/connections/nobody", {}, b"", {}))
    return bool(answer[0] != 404)


def _with_delete_connection(handle: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(handle)
    async def handle_request(method: str, path: str, headers: Any, body: bytes, query: Any) -> Any:
        if method != "DELETE" or not path.startswith("/connections/"):
            return await handle(method, path, headers, body, query)
        client = unquote(path[len("/connections/") :])
        session = iot._connected_clients.get((get_account_id(), get_region(), client))
        if session is None:
            return error_response_json("ResourceNotFoundException", f"Client {client} is not connected", 404)
        if _flag(query, "preventWillMessage"):
            session._will_topic = None
        if _flag(query, "cleanSession"):
            session._persist_session = False
        await end_session(session, "API_INITIATED_DISCONNECT", _ADMINISTRATIVE_ACTION)
        return 200, {"Content-Type": "application/json"}, b""

    return handle_request


def _flag(query: Any, name: str) -> bool:
    value = query.get(name)
    return str(value[0] if isinstance(value, list) else value).lower() == "true"
