"""Stands in for a rosbridge server: aiohttp's WebSockets on loopback, in a thread of its own.

Speaks the protocol's subscribe, unsubscribe, advertise and publish; sends a topic's messages to those
who have subscribed to it on this very connection, as the real one does.
"""

from __future__ import annotations

import asyncio
import json
import threading
from typing import Any

from aiohttp import WSMsgType, web
from typing_extensions import Self

from tests.ports import free_port


class RosbridgeStandin:
    """Runs while it is entered; may be entered again, on the same port."""

    def __init__(self, port: int | None = None) -> None:
        self.port = port or free_port()
        self.operations: list[dict[str, Any]] = []
        self.pings = 0
        self.deaf = False
        self._changed = threading.Condition()
        self._sockets: dict[web.WebSocketResponse, set[str]] = {}
        self._transports: list[asyncio.Transport] = []

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="rosbridge", daemon=True)
        self._thread.start()
        assert ready.wait(60)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(60)
        assert not self._thread.is_alive()

    def wait_for(self, operation: str, count: int = 1, **members: Any) -> dict[str, Any]:
        """The operation of that kind, once the client has sent it so often."""

        def matching() -> list[dict[str, Any]]:
            wanted = {"op": operation, **members}
            return [op for op in self.operations if wanted.items() <= op.items()]

        with self._changed:
            assert self._changed.wait_for(lambda: len(matching()) >= count, 60), self.operations
            return matching()[count - 1]

    def publish(self, topic: str, message: Any) -> None:
        self.send(json.dumps({"op": "publish", "topic": topic, "msg": message}), topic)

    def send(self, text: str, topic: str | None = None) -> None:
        """Send to every client, or to a topic's subscribers."""

        async def to_all() -> None:
            for client, topics in self._sockets.items():
                if topic is None or topic in topics:
                    await client.send_str(text)

        asyncio.run_coroutine_threadsafe(to_all(), self._loop).result(60)

    def cut(self) -> None:
        """Drop the connections without a word, as a router that is switched off does."""

        async def abort() -> None:
            while self._transports:
                self._transports.pop().abort()

        asyncio.run_coroutine_threadsafe(abort(), self._loop).result(60)

    def _run(self, ready: threading.Event) -> None:
        asyncio.run(self._serve(ready))

    async def _serve(self, ready: threading.Event) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        app = web.Application()
        app.router.add_get("/", self._client)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", self.port, reuse_address=True).start()
        ready.set()
        await self._over.wait()
        for client in list(self._sockets):
            await client.close()
        await runner.cleanup()

    async def _client(self, request: web.Request) -> web.WebSocketResponse:
        client = web.WebSocketResponse(autoping=False)
        await client.prepare(request)
        self._sockets[client] = set()
        assert request.transport is not None
        self._transports.append(request.transport)
        try:
            async for message in client:
                if message.type == WSMsgType.PING and not self.deaf:
                    self.pings += 1
                    await client.pong(message.data)
                if message.type == WSMsgType.TEXT:
                    self._note(client, json.loads(message.data))
        finally:
            del self._sockets[client]
        return client

    def _note(self, client: web.WebSocketResponse, operation: dict[str, Any]) -> None:
        if operation["op"] == "subscribe":
            self._sockets[client].add(operation["topic"])
        elif operation["op"] == "unsubscribe":
            self._sockets[client].discard(operation["topic"])
        with self._changed:
            self.operations.append(operation)
            self._changed.notify_all()
