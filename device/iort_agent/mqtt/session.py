"""MQTT 5 by hand, for `iort-agent check`: over a socket whose every step has been checked, and which says why
the broker refuses. The running agent uses AWS' client."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from types import TracebackType

CONNECT, CONNACK, PUBLISH, SUBSCRIBE, SUBACK, DISCONNECT = 1, 2, 3, 8, 9, 14
_KEEP_ALIVE_S = 30
_CLEAN_START = 2
# Reason codes from here on are refusals.
_FIRST_REFUSAL = 0x80
# Of a packet's length, in MQTT 5; and of an answer's body, which ends with its properties or its codes.
_MOST_LENGTH_BYTES, _LEAST_BYTES = 4, 3
# The codes that a robot may get.
_REASONS = {
    0x80: "unspecified error",
    0x81: "malformed packet",
    0x85: "client id not valid",
    0x87: "not authorized",
    0x88: "server unavailable",
    0x89: "server busy",
    0x8E: "another client took over this name",
}


class RefusalError(Exception):
    """The broker has answered, and its answer is no."""


class ForeignError(OSError):
    """The other side speaks something else than MQTT 5."""


class Session:
    """A session over an open socket. Its methods raise `OSError` if the socket fails, and `RefusalError`."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected

    def __enter__(self) -> Session:  # noqa: PYI034 - Self came with Python 3.11
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with contextlib.suppress(OSError):
            self._send(DISCONNECT << 4, b"")
        self._socket.close()

    def connect(self, client_id: str) -> None:
        """Start a session that ends with the connection."""
        head = _text("MQTT") + bytes([5, _CLEAN_START]) + struct.pack(">HB", _KEEP_ALIVE_S, 0)
        try:
            self._send(CONNECT << 4, head + _text(client_id))
        except OSError:
            # The server's reason, such as a TLS alert, may have come before.
            self._read(1)
            raise
        self._accepted(self._receive(CONNACK)[1])

    def subscribe(self, topic: str) -> None:
        """Subscribe to a topic, with QoS 0."""
        # Packet id 1, which is free again with each answer; no properties.
        self._send(SUBSCRIBE << 4 | 2, b"\x00\x01\x00" + _text(topic) + b"\x00")
        self._accepted(self._receive(SUBACK)[-1])

    def round_trip(self, topic: str, payload: bytes, answer_topic: str, timeout_s: float) -> bytes | None:
        """Publish a message, with QoS 0, and return the next one on a topic; None without one in time."""
        self._send(PUBLISH << 4, _text(topic) + b"\x00" + payload)
        deadline = time.monotonic() + timeout_s
        try:
            while (left_s := deadline - time.monotonic()) > 0:
                self._socket.settimeout(left_s)
                body = self._receive(PUBLISH)
                end = 2 + struct.unpack_from(">H", body)[0]
                if body[2:end] == answer_topic.encode():
                    length, start = _varint(body, end)
                    return body[start + length :]
        except socket.timeout:
            pass
        return None

    def _accepted(self, code: int) -> None:
        if code >= _FIRST_REFUSAL:
            raise RefusalError(_REASONS.get(code, f"reason {code:#x}"))

    def _send(self, first: int, body: bytes) -> None:
        length, size = b"", len(body)
        while size > 127:
            length, size = length + bytes([size & 127 | 128]), size >> 7
        self._socket.sendall(bytes([first]) + length + bytes([size]) + body)

    def _receive(self, kind: int) -> bytes:
        """The body of the next packet of this kind; others are skipped."""
        while True:
            first = self._read(1)[0] >> 4
            length = b""
            while not length or length[-1] & 128:
                length += self._read(1)
                if len(length) > _MOST_LENGTH_BYTES:
                    raise ForeignError
            body = self._read(_varint(length, 0)[0])
            if first == kind:
                if len(body) < _LEAST_BYTES:
                    raise ForeignError
                return body
            if first == DISCONNECT:
                self._accepted(body[0] if body else 0)

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self._socket.recv(count - len(data))
            if not more:
                raise ConnectionResetError("the broker hangs up")
            data += more
        return data


def _text(text: str) -> bytes:
    return struct.pack(">H", len(text.encode())) + text.encode()


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of MQTT's variable length, and the place behind it."""
    value = shift = 0
    while True:
        value |= (data[at] & 127) << shift
        at, shift = at + 1, shift + 7
        if not data[at - 1] & 128:
            return value, at
