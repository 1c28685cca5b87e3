"""A stand-in for the upload function and S3: it answers over a loopback uplink and accepts PUTs by HTTPS."""

from __future__ import annotations

import hashlib
import http.server
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iort_agent.mqtt.uplink import MqttMessage
from iort_contract.messages.files import (
    Address,
    FileAnswer,
    FileRequest,
    decode_file_request,
    encode_file_answer,
    file_key,
    part_range,
)
from iort_contract.topics import FILE, PING, PONG, build_topic
from local.network.certificates import Authority
from testkit.agent import Loopback


class Store:
    """The bucket's content, and the faults to make: each PUT takes one from ``faults``, until it is empty.

    Faults: an HTTP status, ``reset`` (the connection ends in the middle of the body), ``mute`` (the body
    is read and never answered).
    """

    def __init__(self, uplink: Loopback, url: str, *, robot: str = "car") -> None:
        self._uplink, self._url = uplink, url
        self._answers = build_topic(PONG, robot, FILE)
        self.requests: list[FileRequest] = []
        self.puts: list[int] = []
        self.parts: dict[int, bytes] = {}
        self.objects: dict[str, bytes] = {}
        self.faults: list[int | str] = []
        self.refusals: list[tuple[str, int | None]] = []
        self.silent = 0
        self.hashes: dict[int, str] = {}
        self.robot = robot
        uplink.subscribe(build_topic(PING, robot, FILE), self._on_request)

    def _on_request(self, message: MqttMessage) -> None:
        request = decode_file_request(message.payload)
        self.requests.append(request)
        if self.silent:
            self.silent -= 1
            return
        self._uplink.deliver(self._answers, encode_file_answer(self._answer(request)))

    def _answer(self, request: FileRequest) -> FileAnswer:
        key = file_key(self.robot, request.file)
        if self.refusals:
            refused, again_s = self.refusals.pop(0)
            return FileAnswer(request.id, refused=refused, again_s=again_s)
        if key not in self.objects and request.parts_sha256 and len(self.parts) == request.file.parts:
            self.objects[key] = b"".join(self.parts[n] for n in sorted(self.parts))
            self.parts.clear()
        if key in self.objects:
            return FileAnswer(request.id, key, stored=True)
        self.hashes.update(request.parts)
        addresses = [
            Address(n, f"{self._url}/{n}?signed=yes", {"content-length": str(self._size(request, n))})
            for n in request.parts
            if n not in self.parts
        ]
        have = [(n, n) for n in sorted(self.parts)] if request.file.parts > 1 else []
        return FileAnswer(request.id, key, stored=False, have=have, addresses=addresses)

    @staticmethod
    def _size(request: FileRequest, part: int) -> int:
        return part_range(request.file, part)[1]

    def put(self, part: int, content: bytes) -> int:
        """Accept a part if it equals the announced one; return the HTTP status."""
        if hashlib.sha256(content).hexdigest() != self.hashes[part]:
            return 400
        self.parts[part] = content
        return 200


class _Handler(http.server.BaseHTTPRequestHandler):
    def do_PUT(self) -> None:
        store: Store = self.server.store
        part = int(self.path.split("?")[0].strip("/"))
        store.puts.append(part)
        size = int(self.headers["content-length"])
        fault = store.faults.pop(0) if store.faults else None
        if fault == "reset":
            self.rfile.read(size // 2)
            self.close_connection = True
            return
        content = self.rfile.read(size)
        if fault == "mute":
            self.close_connection = True
            return
        status = fault if isinstance(fault, int) else store.put(part, content)
        body = b"<Error><Code>BadDigest</Code></Error>" if status == 400 else b""
        self.send_response(status)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: Any) -> None:
        """Some tests disconnect on purpose."""


@contextmanager
def store(uplink: Loopback, folder: Path) -> Iterator[tuple[Store, Path]]:
    """Yield the stand-in and the certificate to trust."""
    certificate, key = Authority().write(folder, "store", "127.0.0.1")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    with _Server(("127.0.0.1", 0), _Handler) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        server.store = Store(uplink, f"https://127.0.0.1:{server.server_port}")
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield server.store, certificate
        finally:
            server.shutdown()
            thread.join()
