"""Probes for each patch in local/patches/: a function returns whether the imported ministack lacks it."""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import MagicMock, Mock, patch

from ministack import app as ministack_app
from ministack.core import iam_actions, iam_evaluator, lambda_runtime
from ministack.core.responses import request_scope
from ministack.services import cloudwatch_logs, dynamodb, iot, iot_data, lambda_svc, sqs

from testkit.waiting import GUARD_S

SEND_MESSAGE_BATCH_REQUEST: tuple[Any, ...] = (
    "sqs",
    "POST",
    "/",
    {"x-amz-target": "AmazonSQS.SendMessageBatch"},
    b"{}",
    {},
)


def send_message_batch() -> bool:
    """Ask for a request's action."""
    return bool(iam_actions.extract_iam_action(*SEND_MESSAGE_BATCH_REQUEST) != "sqs:SendMessage")


STREAM_ARN_REQUEST: tuple[Any, ...] = (
    "dynamodbstreams",
    "POST",
    "/",
    {},
    b'{"StreamArn": "arn:stream"}',
    {},
    "eu-west-1",
    "000000000000",
)


def stream_arn() -> bool:
    """Ask for a request's resource."""
    return bool(iam_actions.extract_resource_arn(*STREAM_ARN_REQUEST) != "arn:stream")


SHADOW_ARN_REQUEST: tuple[Any, ...] = (
    "iot-data",
    "GET",
    "/things/car/shadow",
    {},
    b"",
    {"name": "one"},
    "eu-west-1",
    "000000000000",
)


def shadow_arn() -> bool:
    """Ask for a request's resource."""
    return not iam_actions.extract_resource_arn(*SHADOW_ARN_REQUEST).endswith(":thing/car/one")


def policy_target() -> bool:
    """Ask for a request's resource."""
    body = b'{"target": "arn:aws:iot:r:0:cert/1"}'
    request = ("iot", "PUT", "/target-policies/robot", {}, body, {}, "r", "0")
    return iam_actions.extract_resource_arn(*request) == "*"


def connect_timeout() -> bool:
    """Read the source for a time limit: no finite wait shows that a connection would stay for ever."""
    source = inspect.getsource(iot._mtls_serve_conn) + inspect.getsource(iot._MtlsAcceptor)
    return "timeout" not in source and "wait_for" not in source


CERTIFICATE_FROM_CSR_TOPIC = "$aws/certificates/create-from-csr/json"


def certificate_from_csr() -> bool:
    """Ask whether the topic is known."""
    return iot._parse_fleet_provisioning_topic(CERTIFICATE_FROM_CSR_TOPIC) is None


def client_hello() -> bool:
    """Check whether reading is paused within `connection_made`; newer Pythons do not show the effect."""

    async def run() -> bool:
        transport = Mock()
        iot._MtlsAcceptor().connection_made(transport)
        paused = bool(transport.pause_reading.called)
        # Let its tasks finish.
        for _ in range(3):
            await asyncio.sleep(0)
        return paused

    async def no_context() -> None:
        return None

    with patch.object(iot, "_mtls_context", no_context):
        return asyncio.run(run())


def certificate_status() -> bool:
    """Deactivate the certificate of a session, and check whether the session is still open."""
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


def bind_address() -> bool:
    """Start the listener on a free port, and read its address."""

    async def run() -> str:
        with patch.object(iot, "_mtls_port", lambda: 0), patch.dict(os.environ, BIND_HOST="127.0.0.1"):
            await iot._mtls_start_locked()
        server, iot._mtls_server, iot._mtls_loop = iot._mtls_server, None, None
        address = server.sockets[0].getsockname()[0]
        server.close()
        await server.wait_closed()
        return str(address)

    return asyncio.run(run()) != "127.0.0.1"


def delete_connection() -> bool:
    """Delete the connection of a client that is not connected: AWS answers 404."""
    answer = asyncio.run(iot_data.handle_request("DELETE", "/connections/nobody", {}, b"", {}))
    return bool(answer[0] != 404)


AWS_MESSAGE_BYTES = 128 * 1024


def message_size() -> bool:
    """Publish one byte too many, without subscribers."""
    payload = b"x" * (AWS_MESSAGE_BYTES + 1)
    try:
        asyncio.run(iot.broker_publish("000000000000", "eu-west-1", "gaps/message_size", payload))
    except ConnectionError:
        return False
    return True


def republish_topic() -> bool:
    """Run a rule that republishes, and read the target topic."""
    topics = []

    async def publish(_account: str, _region: str, topic: str, *_: Any, **__: Any) -> None:
        topics.append(topic)

    rule = {"sql": "SELECT * FROM 'a/b'", "actions": [{"republish": {"topic": "c/${topic(2)}"}}]}
    with patch.object(iot, "broker_publish", publish):
        asyncio.run(iot._run_rule_actions("000000000000", "eu-west-1", rule, b"{}", "a/b"))
    return topics != ["c/b"]


def sql_floor() -> bool:
    """Evaluate a statement with floor()."""
    event = iot._rule_event("SELECT floor(1.5) AS n FROM 'a'", "a", b"{}", message={})
    return bool(event != {"n": 1})


def sqs_action_tls() -> bool:
    """Run the action, and read the policy conditions of its request."""
    secure = []

    def send(*_: Any) -> dict[str, str]:
        secure.append(iam_evaluator._request_origin.get()[1])
        return {"MessageId": ""}

    with patch.multiple(sqs, _get_q=lambda *_: {"is_fifo": False}, _act_send_message=send):
        arguments: tuple[Any, ...] = ("000000000000", "eu-west-1", "rule", {"queueUrl": "queue"}, {})
        contextvars.Context().run(iot._dispatch_rule_sqs, *arguments)
    return secure != [True]


def unreadable_payload() -> bool:
    """Read both kinds of payload."""
    try:
        iot._rule_message(b"[" * 50_000 + b"]" * 50_000)
        iot._rule_message(b"9" * 5_000)
    except (RecursionError, ValueError):
        return True
    return False


def queue_lock() -> bool:
    """Send a message, and check whether the lock was taken. (test_object_fixes.py loses messages.)"""
    lock = MagicMock()
    with patch.object(sqs, "_queues_lock", lock), request_scope("000000000000", "eu-west-1"):
        url = sqs._act_create_queue({"QueueName": "gaps-queue-lock"}, "")["QueueUrl"]
        lock.reset_mock()
        sqs._HANDLERS["SendMessage"]({"MessageBody": "text"}, url)
        taken = lock.__enter__.called
        sqs._act_delete_queue({"QueueUrl": url}, "")
    return not taken


LOG_LEVELS_HANDLER = (
    "import logging\ndef handler(event, context):\n    logging.getLogger('x').warning('text')\n"
)


def log_levels() -> bool:
    """Run the worker with a function that logs."""
    with TemporaryDirectory() as folder:
        (Path(folder) / "logs.py").write_text(LOG_LEVELS_HANDLER)
        init = {"code_dir": folder, "module": "logs", "handler": "handler"}
        done = subprocess.run(
            [sys.executable, "-c", lambda_runtime._PYTHON_WORKER_SCRIPT],
            input=f'{json.dumps(init)}\n{{"event": {{}}}}\n',
            capture_output=True,
            text=True,
            check=True,
            timeout=GUARD_S,
        )
    return "[WARNING]" not in done.stderr


def log_records() -> bool:
    """Write the log of a function that failed, and count its events."""
    written = []
    with (
        patch.object(cloudwatch_logs, "_append_log_events", lambda _stream, events: written.extend(events)),
        request_scope("000000000000", "eu-west-1"),
    ):
        text = 'Traceback (most recent call last):\n  File "x.py", line 1\nValueError: text'
        lambda_svc._emit_lambda_logs({"config": {}}, "id", text, True, 0)
    # Beside the lines of Lambda itself: START, END and REPORT.
    return len(written) != 4


# An upgrade to MQTT over WebSocket, unsigned.
HANDSHAKE: dict[str, Any] = {
    "type": "websocket",
    "path": "/mqtt",
    "query_string": b"",
    "headers": [(b"host", b"127.0.0.1:4566"), (b"sec-websocket-protocol", b"mqtt")],
}


def websocket_host() -> bool:
    """Ask for the gateway's own host, and see whether the broker takes the connection."""
    taken = []

    async def take(*_: Any) -> None:
        taken.append(True)

    async def closed() -> dict[str, str]:
        return {"type": "websocket.connect"}

    async def send(_message: dict[str, Any]) -> None:
        pass

    with patch.object(iot, "handle_websocket", take):
        asyncio.run(ministack_app.app(HANDSHAKE, closed, send))
    return not taken


def unsigned_websocket() -> bool:
    """Ask whether an unsigned upgrade is refused where requests are checked."""
    with patch.object(ministack_app, "AUTH", True):
        return iot._ws_handshake_check(HANDSHAKE) is None


def ttl_pass() -> bool:
    """Ask for the function."""
    return not hasattr(dynamodb, "_expire_items")


def function_credentials() -> bool:
    """Derive a secret from what is no secret."""
    config = {
        "FunctionArn": "arn:aws:lambda:eu-west-1:000000000000:function:one",
        "Role": "arn:aws:iam::000000000000:role/one",
    }
    digest = hashlib.sha256("{FunctionArn}:{Role}".format(**config).encode()).hexdigest()
    derived = hashlib.sha256(f"secret:{digest}".encode()).hexdigest()
    with patch.object(ministack_app, "AUTH", True):
        return bool(lambda_runtime.execution_credentials(config)["AWS_SECRET_ACCESS_KEY"] == derived)


def root_signature() -> bool:
    """Look whether a signature of root's is kept for its check."""
    credential = "Credential=test/20260101/eu-west-1/dynamodb/aws4_request"
    signed = f"AWS4-HMAC-SHA256 {credential}, SignedHeaders=host, Signature=00"
    with patch.object(ministack_app, "AUTH", True), patch.dict(os.environ, AWS_SECRET_ACCESS_KEY="own"):
        iam_evaluator.pin_signed_request("POST", "/", {}, [(b"authorization", signed.encode())])
        return iam_evaluator._signed_request.get() is None
