"""A small MQTT 5 broker over WebSockets, for pages: QoS 0, and no rights."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from contextlib import suppress

from aiohttp import web

from iort_agent.mqtt.uplink import matches
from iort_station.page.background import BackgroundServer

CONNECT, PUBLISH, SUBSCRIBE, UNSUBSCRIBE, PING = 1, 3, 8, 10, 12
CONNACK, SUBACK, UNSUBACK, PONG = bytes([0x20, 3, 0, 0, 0]), 0x90, 0xB0, bytes([0xD0, 0])


def _length(sent: bytes | bytearray, at: int) -> tuple[int, int] | None:
    """A number in groups of seven bits, of which the last has no high bit, and where it ends; None if it is
    cut off."""
    for end in range(at + 1, at + 5):
        if end > len(sent):
            return None
        if sent[end - 1] < 0x80:
            return sum((sent[i] & 0x7F) << 7 * (i - at) for i in range(at, end)), end
    raise ValueError("no length has five bytes")


def packets(sent: bytearray) -> Iterator[tuple[int, bytes]]:
    """Take the whole MQTT packets from the front of what was sent: kind and body."""
    while len(sent) > 1 and (head := _length(sent, 1)):
        length, begin = head
        if len(sent) < begin + length:
            return
        kind, body = sent[0] >> 4, bytes(sent[begin : begin + length])
        del sent[: begin + length]
        yield kind, body


def _text(body: bytes, at: int) -> tuple[str, int]:
    end = at + 2 + int.from_bytes(body[at : at + 2], "big")
    return body[at + 2 : end].decode(), end


def _packed(kind: int, body: bytes) -> bytes:
    length, head = len(body), bytearray([kind])
    while True:
        length, group = length >> 7, length & 0x7F
        head.append(group | (0x80 if length else 0))
        if not length:
            return bytes(head) + body


class PageBroker(BackgroundServer):
    """``taken`` has what pages have published: topic and payload. `on_publish` is called with each."""

    def __init__(self) -> None:
        super().__init__("127.0.0.1", 0)
        self.taken: list[tuple[str, bytes]] = []
        self.on_publish: list[Callable[[str, bytes], object]] = []
        self._pages: dict[web.WebSocketResponse, set[str]] = {}

    @property
    def origin(self) -> str:
        return f"ws://{self.host}:{self.port}"

    def address(self, _asked: object) -> dict[str, str]:
        """Answers ``socket`` and ``drive``."""
        return {"url": f"{self.origin}/mqtt", "client_id": f"page-{len(self.taken)}-{id(object())}"}

    def heard(self, topic: str) -> bool:
        """Whether a page has subscribed to it."""
        return any(matches(one, topic) for filters in list(self._pages.values()) for one in filters)

    def sent(self, ends: str) -> list[dict[str, object]]:
        """The JSON messages on topics that end so."""
        return [json.loads(payload) for topic, payload in list(self.taken) if topic.endswith(ends)]

    def publish(self, topic: str, payload: bytes) -> None:
        """Send a message to the pages that hear it; from any thread."""
        name = topic.encode()
        packet = _packed(PUBLISH << 4, len(name).to_bytes(2, "big") + name + b"\0" + payload)
        asyncio.run_coroutine_threadsafe(self._send(topic, packet), self._loop)

    def drop(self) -> None:
        """End every page's connection."""

        async def close() -> None:
            for page in list(self._pages):
                await page.close()

        asyncio.run_coroutine_threadsafe(close(), self._loop)

    async def _send(self, topic: str, packet: bytes) -> None:
        for page, filters in list(self._pages.items()):
            if any(matches(one, topic) for one in filters) and not page.closed:
                await page.send_bytes(packet)

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        page = web.WebSocketResponse(protocols=["mqtt"])
        await page.prepare(request)
        self._pages[page] = set()
        sent = bytearray()
        try:
            # A page may go before it is answered.
            with suppress(ConnectionResetError):
                async for message in page:
                    sent += message.data
                    for kind, body in packets(sent):
                        await self._follow(page, kind, body)
        finally:
            del self._pages[page]
        return page

    async def _follow(self, page: web.WebSocketResponse, kind: int, body: bytes) -> None:
        if kind == CONNECT:
            await page.send_bytes(CONNACK)
        elif kind == PING:
            await page.send_bytes(PONG)
        elif kind == PUBLISH:
            topic, at = _text(body, 0)
            properties, at = _length(body, at) or (0, at)
            payload = body[at + properties :]
            self.taken.append((topic, payload))
            for take in self.on_publish:
                take(topic, payload)
        elif kind in {SUBSCRIBE, UNSUBSCRIBE}:
            properties, at = _length(body, 2) or (0, 2)
            at += properties
            count = 0
            while at < len(body):
                topic, at = _text(body, at)
                at += kind == SUBSCRIBE
                count += 1
                (self._pages[page].add if kind == SUBSCRIBE else self._pages[page].discard)(topic)
            answer = SUBACK if kind == SUBSCRIBE else UNSUBACK
            await page.send_bytes(_packed(answer, body[:2] + bytes(1 + count)))
