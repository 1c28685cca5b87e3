"""Lambda's Runtime API for one environment, and a stand-in for the services that functions call.

Source: Lambda, "Using the Lambda runtime API".
"""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

_VERSION = "/2018-06-01/runtime"
NEXT, RESPONSE, ERROR, INIT_ERROR = "next", "response", "error", "init/error"
# Used for both of PubNub's keys; no log may contain it.
PUBNUB_KEY = "a-key-of-pubnub"
ARN = "arn:aws:lambda:eu-west-1:000000000000:function:"


class Call(NamedTuple):
    """One call of the runtime: its kind (one of four), the document, and the error's type."""

    kind: str
    document: Any
    error_type: str | None


class RuntimeApi:
    """Hands out ``events``; puts every call of the runtime into ``calls``."""

    def __init__(self, function: str, timeout_s: int) -> None:
        self.calls: queue.Queue[Call] = queue.Queue()
        self._events: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._function, self._timeout_s = function, timeout_s

    def send(self, event: dict[str, Any]) -> None:
        """Give the next event."""
        self._events.put(event)

    def end(self) -> None:
        """Release a runtime that waits for an event."""
        self._events.put(None)

    def next(self, asked: BaseHTTPRequestHandler) -> None:
        """Wait for an event and answer the runtime with it."""
        self.calls.put(Call(NEXT, None, None))
        event = self._events.get()
        if event is None:
            asked.close_connection = True
            return
        deadline_ms = int((time.time() + self._timeout_s) * 1000)
        _answer(
            asked,
            json.dumps(event).encode(),
            {
                "Lambda-Runtime-Aws-Request-Id": "8476a536-e9f4-11e8-9739-2dfe598c3fcd",
                "Lambda-Runtime-Deadline-Ms": str(deadline_ms),
                "Lambda-Runtime-Invoked-Function-Arn": ARN + self._function,
                "Lambda-Runtime-Trace-Id": "Root=1-5bef4de7-ad49b0e87f6ef6c87fc2e700;Sampled=0",
            },
        )

    def told(self, asked: BaseHTTPRequestHandler, body: bytes) -> None:
        """Record a report of the runtime on an invocation or on its start."""
        kind = next(one for one in (INIT_ERROR, RESPONSE, ERROR) if asked.path.endswith(f"/{one}"))
        error_type = asked.headers.get("Lambda-Runtime-Function-Error-Type")
        self.calls.put(Call(kind, json.loads(body), error_type))
        _answer(asked, b'{"status":"OK"}', status=202)


# By operation, the last part of X-Amz-Target. Everything else of these protocols is answered with {}.
_JSON: dict[str, Any] = {"BatchWriteItem": {"UnprocessedItems": {}}, "SendMessage": {"MessageId": "1"}}


class Services:
    """A stand-in for DynamoDB, SSM, SQS, SNS, IoT, S3 and PubNub, which stores nothing.

    Every table has the ``items``; ``asked`` has the operations in order.
    """

    def __init__(self) -> None:
        self.items: list[dict[str, Any]] = []
        self.asked: list[str] = []

    def answer(self, asked: BaseHTTPRequestHandler, body: bytes) -> None:
        """Answer one request."""
        path, host = asked.path.partition("?")[0], asked.headers["Host"]
        if target := asked.headers.get("X-Amz-Target"):
            operation = target.rpartition(".")[2]
            given = _JSON.get(operation, {})
            if operation == "GetParameter":
                keys = {"publish_key": PUBNUB_KEY, "subscribe_key": PUBNUB_KEY, "origin": host, "tls": False}
                given = {"Parameter": {"Name": "keys", "Value": json.dumps(keys)}}
            elif operation in {"Query", "Scan"}:
                given = {"Items": self.items, "Count": len(self.items), "ScannedCount": len(self.items)}
            self._answer(asked, operation, json.dumps(given).encode())
        elif path.startswith("/publish/"):
            self._answer(asked, "PubNub", b'[1,"Sent","16000000000000000"]')
        elif path.startswith("/topics/"):
            self._answer(asked, "Topic", b"{}")
        elif b"Action=Publish" in body:
            result = b"<PublishResult><MessageId>1</MessageId></PublishResult>"
            self._answer(asked, "Mail", b"<PublishResponse>" + result + b"</PublishResponse>")
        elif "list-type=2" in asked.path:
            self._answer(asked, "Objects", b"<ListBucketResult/>")
        else:
            # The bucket takes everything, and has nothing yet.
            written = asked.command == "PUT"
            self._answer(asked, "Write" if written else "Object", b"", status=200 if written else 404)

    def _answer(self, asked: BaseHTTPRequestHandler, operation: str, body: bytes, status: int = 200) -> None:
        self.asked.append(operation)
        _answer(asked, body, status=status)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    api: RuntimeApi
    services: Services

    def _any(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.headers.get("Transfer-Encoding") == "chunked":
            body = self._chunks()
        if not self.path.startswith(_VERSION):
            self.services.answer(self, body)
        elif self.path.endswith("/next"):
            self.api.next(self)
        else:
            self.api.told(self, body)

    do_GET = do_POST = do_PUT = do_HEAD = do_DELETE = _any  # noqa: N815 - http.server's names

    def _chunks(self) -> bytes:
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body

    def log_message(self, *_: Any) -> None:
        """Log nothing: only the functions' own lines matter."""


def _answer(
    asked: BaseHTTPRequestHandler, body: bytes, headers: dict[str, str] | None = None, status: int = 200
) -> None:
    asked.send_response(status)
    asked.send_header("Content-Type", "application/json")
    asked.send_header("Content-Length", str(len(body)))
    for name, value in (headers or {}).items():
        asked.send_header(name, value)
    asked.end_headers()
    asked.wfile.write(body)


@contextmanager
def served(api: RuntimeApi, services: Services) -> Iterator[str]:
    """Serve both on a port of loopback; yield host and port."""
    handler = type("Handler", (_Handler,), {"api": api, "services": services})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_port}"
    finally:
        api.end()
        server.shutdown()
        server.server_close()
        thread.join()
