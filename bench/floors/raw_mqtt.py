"""The floor of the round trips: the barest MQTT 3.1.1 client, over one blocking TLS socket.

    with RawClient(folder_of_a_robot) as client:
        client.subscribe("ping/iort/car/broker")
        took_s = client.round_trip("ping/iort/car/broker", payload)

MQTT 3.1.1 is the OASIS standard of 2014; its chapters 3.1 to 3.13 define the packets. paho-mqtt is slower
(docs/decisions/developing/0046-the-floor-is-our-own-mqtt-client.md).
"""

from __future__ import annotations

import socket
import ssl
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from typing_extensions import Self

from testkit.waiting import InstrumentError

_TIMEOUT_S = 20.0
_CONNACK, _PUBLISH, _SUBACK, _PINGRESP = 2, 3, 9, 13
_NOTHING = b""


class RawError(InstrumentError):
    """The broker sent an unexpected packet, or none."""


class RawClient:
    """A connection as a registered robot, with its certificate; to ``port`` if given."""

    def __init__(self, bundle: Path, port: int | None = None) -> None:
        self._config: dict[str, Any] = yaml.safe_load((bundle / "car.yaml").read_text())
        self._port = port or int(self._config["port"])
        self._context = ssl.create_default_context(
            cafile=str(bundle / self._config["root_ca"]) if "root_ca" in self._config else None
        )
        self._context.load_cert_chain(
            bundle / self._config["certificate"], bundle / self._config["private_key"]
        )
        self._socket: ssl.SSLSocket

    def __enter__(self) -> Self:
        host = self._config["endpoint"]
        plain = socket.create_connection((host, self._port), timeout=_TIMEOUT_S)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = self._context.wrap_socket(plain, server_hostname=host)
        name = self._config["robot"].encode()
        body = b"\x00\x04MQTT\x04\x02\x00\x3c" + _text(name)
        self._send(0x10, body)
        if self._expect(_CONNACK)[1:2] != b"\x00":
            raise RawError("the broker refused the connection")
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # the broker may have closed first
            self._send(0xE0, _NOTHING)
        self._socket.close()

    def subscribe(self, topic: str) -> None:
        """Receive what is published on the topic, at QoS 0."""
        self._send(0x82, b"\x00\x01" + _text(topic.encode()) + b"\x00")
        if self._expect(_SUBACK)[-1:] != b"\x00":
            raise RawError(f"the broker refused the subscription of {topic}")

    def round_trip(self, topic: str, payload: bytes) -> float:
        """Publish at QoS 0 and wait for it to come back; seconds."""
        packet = _packet(0x30, _text(topic.encode()) + payload)
        began = time.perf_counter()
        self._socket.sendall(packet)
        answer = self._expect(_PUBLISH)
        took = time.perf_counter() - began
        if not answer.endswith(payload):
            raise RawError("the answer must be the message that was sent, got another")
        return took

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish at QoS 0, without waiting."""
        self._socket.sendall(_packet(0x30, _text(topic.encode()) + payload))

    def receive(self) -> tuple[str, bytes]:
        """The next message's topic and payload."""
        body = self._expect(_PUBLISH)
        length = int.from_bytes(body[:2], "big")
        return body[2 : 2 + length].decode(), body[2 + length :]

    def ping(self) -> float:
        """Time a PINGREQ and its PINGRESP, two bytes each, in seconds: a TLS echo of the broker's process."""
        began = time.perf_counter()
        self._send(0xC0, _NOTHING)
        self._expect(_PINGRESP)
        return time.perf_counter() - began

    def _send(self, head: int, body: bytes) -> None:
        self._socket.sendall(_packet(head, body))

    def _expect(self, kind: int) -> bytes:
        head = self._receive(1)[0]
        length, shift = 0, 0
        while True:
            byte = self._receive(1)[0]
            length |= (byte & 0x7F) << shift
            shift += 7
            if not byte & 0x80:
                break
        body = self._receive(length)
        if head >> 4 != kind:
            raise RawError(f"packet type must be {kind}, got {head >> 4}")
        return body

    def _receive(self, count: int) -> bytes:
        parts = []
        while count:
            part = self._socket.recv(min(count, 65536))
            if not part:
                raise RawError("the broker closed the connection")
            parts.append(part)
            count -= len(part)
        return b"".join(parts)


def tcp_connect_s(host: str, port: int) -> float:
    """Time one TCP handshake, which is one round trip of the network; `ping` would need more rights."""
    began = time.perf_counter()
    with socket.create_connection((host, port), timeout=_TIMEOUT_S):
        return time.perf_counter() - began


def _text(text: bytes) -> bytes:
    return struct.pack(">H", len(text)) + text


def _packet(head: int, body: bytes) -> bytes:
    length, left = bytearray(), len(body)
    while True:
        left, byte = divmod(left, 128)
        length.append(byte | (0x80 if left else 0))
        if not left:
            return bytes([head]) + bytes(length) + body
