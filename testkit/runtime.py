"""An execution environment: starts a function under `awslambdaric`, sends events and measures it.

The runtime writes log records as frames to a pipe of Lambda, and the function prints to standard output.
Both are kept apart here, as in Lambda."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import queue
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

from testkit import machine

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
                if "/webhook" in body.decode():
                    keys = {"url": "https://example.org/", "secret": PUBNUB_KEY}
                given = {"Parameter": {"Name": "keys", "Value": json.dumps(keys)}}
            elif operation in {"Query", "Scan"}:
                given = {"Items": self.items, "Count": len(self.items), "ScannedCount": len(self.items)}
            elif operation == "UpdateItem" and '"UPDATED_NEW"' in body.decode():
                # Every count that is asked for is at its beginning.
                changed = json.loads(body)["ExpressionAttributeNames"].values()
                given = {"Attributes": {name: {"N": "1"} for name in changed}}
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


_ANSWER_S = 60.0
REGION = "eu-west-1"
# boto3 and the client that runs the functions, each with its dependencies.
RUNTIME_PACKAGES = (
    *("boto3", "botocore", "dateutil", "jmespath", "s3transfer", "six", "urllib3"),
    *("awslambdaric", "runtime_client", "simplejson", "snapshot_restore_py"),
)
_FRAME = struct.Struct(">4sIQ")
_MB = 1024


class RuntimeFailedError(Exception):
    """The function did not start, or its runtime ended; the text has the runtime's output."""


@dataclass(frozen=True)
class Function:
    """A deployed function: the folder of its code, and its configuration."""

    name: str
    handler: str
    code: Path
    layer: Path | None
    memory_mb: int
    timeout_s: int
    environment: Mapping[str, str]
    log_format: str
    log_level: str


@dataclass
class Environment:
    """A started function. ``start_cpu_ms`` is the processor time of all threads until the first request for
    an event. ``printed`` and ``logged`` are complete when the process has ended."""

    api: RuntimeApi
    services: Services
    process: subprocess.Popen[bytes]
    start_cpu_ms: float = 0.0
    printed: list[str] = field(default_factory=list)
    logged: list[str] = field(default_factory=list)

    def wait_for_start(self) -> None:
        """Wait until the runtime asks for its first event. Raises `RuntimeFailedError` if it ends before."""
        first = self._call()
        if first.kind != NEXT:
            raise RuntimeFailedError(str(first.document))
        self.start_cpu_ms = self.cpu_ms()

    def invoke(self, event: dict[str, Any]) -> Call:
        """Send an event, wait until the runtime asks for the next one, and return the answer.

        Every table has the items of the event's stream records.
        """
        records = event.get("Records", [])
        self.services.items = [one["dynamodb"]["NewImage"] for one in records if "dynamodb" in one]
        self.api.send(event)
        answer = self._call()
        assert self._call().kind == NEXT
        return answer

    def cpu_ms(self) -> float:
        """Return the processor time so far."""
        return machine.spent_ms({}, machine.threads_ns([self.process.pid]))

    def peak_mb(self) -> float:
        """Return its peak resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / _MB

    def _call(self) -> Call:
        deadline = time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            with contextlib.suppress(queue.Empty):
                return self.api.calls.get(timeout=0.1)
            if self.process.poll() is not None:
                raise RuntimeFailedError(f"the runtime ended with {self.process.returncode}")
        raise RuntimeFailedError(f"the runtime has said nothing for {_ANSWER_S:.0f} s")


@contextlib.contextmanager
def started(function: Function, folder: Path) -> Iterator[Environment]:
    """Run the function in an environment of its own while the block lasts; its files are in ``folder``.

    Raises `RuntimeFailedError` if it does not start.
    """
    api, services = RuntimeApi(function.name, function.timeout_s), Services()
    own = folder / "runtime"
    link_runtime(own)
    printed, logged = folder / "printed", folder / "logged"
    with served(api, services) as address, printed.open("wb") as out, logged.open("wb") as log:
        process = subprocess.Popen(
            # -S and -s: only the linked packages of this environment are on the path.
            [sys.executable, "-S", "-s", "-m", "awslambdaric", function.handler],
            cwd=function.code,
            env=_variables(function, address, own, log.fileno()),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            pass_fds=[log.fileno()],
        )
        found = Environment(api, services, process)
        try:
            found.wait_for_start()
            yield found
        finally:
            process.kill()
            process.wait()
            found.printed += printed.read_text().splitlines()
            found.logged += frames(logged.read_bytes())


def frames(data: bytes) -> list[str]:
    """Yield the messages of a runtime's output; each follows its type, length and time."""
    found = []
    while data:
        _, length, _ = _FRAME.unpack(data[: _FRAME.size])
        found.append(data[_FRAME.size : _FRAME.size + length].decode())
        data = data[_FRAME.size + length :]
    return found


def link_runtime(folder: Path) -> list[Path]:
    """Link the packages that AWS' Python has, from this environment; return their folders and files.

    Raises `RuntimeFailedError` if one is not installed.
    """
    folder.mkdir()
    linked = []
    for name in RUNTIME_PACKAGES:
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            raise RuntimeFailedError(f"{name} is not there: run `make setup`")
        origin = Path(spec.origin)
        origin = origin.parent if origin.name == "__init__.py" else origin
        (folder / origin.name).symlink_to(origin)
        linked.append(origin)
    return linked


def _variables(function: Function, address: str, own: Path, log: int) -> dict[str, str]:
    """Return Lambda's "Defined runtime environment variables", with keys that no AWS accepts."""
    path = [own] if function.layer is None else [function.layer / "python", own]
    return {
        **function.environment,
        "PATH": os.defpath,
        "HOME": str(own),
        "LANG": "en_US.UTF-8",
        "TZ": ":UTC",
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        # The function's folders cannot be written on AWS.
        "PYTHONDONTWRITEBYTECODE": "1",
        "AWS_LAMBDA_RUNTIME_API": address,
        "AWS_LAMBDA_INITIALIZATION_TYPE": "on-demand",
        "AWS_LAMBDA_FUNCTION_NAME": function.name,
        "AWS_LAMBDA_FUNCTION_VERSION": "$LATEST",
        "AWS_LAMBDA_FUNCTION_MEMORY_SIZE": str(function.memory_mb),
        "AWS_LAMBDA_LOG_FORMAT": function.log_format,
        "AWS_LAMBDA_LOG_LEVEL": function.log_level,
        "_LAMBDA_TELEMETRY_LOG_FD": str(log),
        "AWS_REGION": REGION,
        "AWS_DEFAULT_REGION": REGION,
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_ENDPOINT_URL": f"http://{address}",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
