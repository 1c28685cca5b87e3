"""The addresses of ministack itself.

AWS: does not apply; it has none, and every request is signed
  (https://docs.aws.amazon.com/IAM/latest/UserGuide/reference_sigv.html).
ministack: answers unsigned requests below /_ministack/. One erases everything, others show the messages of
  queues and the code of functions, or change settings, whoever on this machine asks.
Test: tests/local/gaps/test_own_paths.py::test_nobody_erases_or_reads_a_cloud_without_a_signature
Patch: none; ministack's own users want these addresses
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import wraps
from typing import Any

from ministack import app

_OWN = ("/_ministack/", "/_localstack/")
# Whether it runs, the broker's authority, and the answers to a deployment, which have an unknown name.
_OPEN = ("/_ministack/ready", "/_ministack/health", "/_ministack/iot/ca.pem")
_OPEN_BELOW = ("/_ministack/cfn-response/", "/_ministack/cfn-signal/")

Serve = Callable[..., Awaitable[None]]


def install() -> None:
    """Close the gap in this process."""
    app.app = _refusing(app.app)


def is_open() -> bool:
    """Ask for the messages of all queues."""
    messages = "/_ministack/sqs/messages"
    status, *_ = asyncio.run(app._handle_sqs_messages_request("GET", messages, {}, {}))
    return bool(status == 200)


def _refusing(serve: Serve) -> Serve:
    @wraps(serve)
    async def answer(scope: dict[str, Any], receive: Any, send: Any) -> None:
        path = scope.get("path", "")
        if scope["type"] != "http" or not path.startswith(_OWN) or _is_open(path):
            await serve(scope, receive, send)
        else:
            await send({"type": "http.response.start", "status": 403, "headers": []})
            await send({"type": "http.response.body", "body": b"this cloud has no such address\n"})

    return answer


def _is_open(path: str) -> bool:
    return path in _OPEN or path.startswith(_OPEN_BELOW)
