"""Stands in for a rosbridge server and its rosapi: aiohttp's WebSockets on loopback, in a thread of its
own.

It does what rosbridge_suite 0.11.17 does in its subscribers.py, subscribe.py and rosapi: the clients share
one ROS subscription for each topic, which ends with the last client; ``subscribe`` without a type to a
topic that is not advertised is forgotten without an answer; a latched message comes with each
subscription; after a restart of the master it is deaf until it subscribes again; a missing service is
answered with ``result: false``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import threading
import time
from typing import Any, Mapping

from aiohttp import WSMsgType, web
from typing_extensions import Self

from iort_contract.ros.definition import DURATION, TIME, Field, parse
from testkit.ports import free_port
from testkit.waiting import GUARD_S


class RosbridgeStandin:
    """Runs while it is entered; may be entered again, on the same port.

    ``advertised`` has each topic's type; without it every topic exists. ``definitions`` has each type's
    text for rosapi; without it there is no rosapi. With ``old``, rosapi does not know
    ``topics_and_raw_types``.
    """

    def __init__(
        self,
        port: int | None = None,
        *,
        advertised: Mapping[str, str] | None = None,
        definitions: Mapping[str, str] | None = None,
        old: bool = False,
    ) -> None:
        self.port = port or free_port()
        self.operations: list[dict[str, Any]] = []
        self.pings = 0
        self.deaf = False
        self.silent_rosapi = False
        self.advertised = None if advertised is None else dict(advertised)
        self.definitions = None if definitions is None else dict(definitions)
        self._old = old
        self._changed = threading.Condition()
        self._clients: dict[web.WebSocketResponse, dict[str, _Subscription]] = {}
        # Topic -> the master at which the server subscribed to it.
        self._subscribers: dict[str, int] = {}
        self._master = 0
        self._latched: dict[str, dict[str, str]] = {}
        self._transports: list[asyncio.Transport] = []

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), name="rosbridge", daemon=True)
        self._thread.start()
        assert ready.wait(GUARD_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(GUARD_S)
        assert not self._thread.is_alive()

    def wait_for(self, operation: str, count: int = 1, **members: Any) -> dict[str, Any]:
        """Return the operation of that kind, once the client has sent ``count`` of them."""

        def matching() -> list[dict[str, Any]]:
            wanted = {"op": operation, **members}
            return [op for op in self.operations if wanted.items() <= op.items()]

        with self._changed:
            assert self._changed.wait_for(lambda: len(matching()) >= count, 120), self.operations
            return matching()[count - 1]

    def publish(self, topic: str, message: Any, *, latch: str | None = None) -> bool:
        """Publish in the graph; ``latch`` names a publisher that keeps it for later subscribers. Return
        whether a client was connected that subscribes to it.
        """
        text = json.dumps({"op": "publish", "topic": topic, "msg": message})
        if latch is not None:
            self._latched.setdefault(topic, {})[latch] = text
        return bool(self._do(self._deliver(topic, text)))

    def send(self, text: str) -> None:
        """Send to every client."""

        async def to_all() -> None:
            for client in list(self._clients):
                await client.send_str(text)

        self._do(to_all())

    def restart_master(self) -> None:
        """Restart the ROS master: publishers register again, but the server does not."""
        self._master += 1

    def cut(self) -> None:
        """Drop the connections without a notice, as a powered-off router does."""

        async def abort() -> None:
            while self._transports:
                self._transports.pop().abort()

        self._do(abort())

    def _do(self, what: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(what, self._loop).result(60)

    def _run(self, ready: threading.Event) -> None:
        asyncio.run(self._serve(ready))

    async def _serve(self, ready: threading.Event) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        self._subscribers = {}
        app = web.Application()
        app.router.add_get("/", self._client)
        runner = web.AppRunner(app, shutdown_timeout=0.1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", self.port, reuse_address=True).start()
        ready.set()
        await self._over.wait()
        for client in list(self._clients):
            await client.close()
        await runner.cleanup()

    async def _client(self, request: web.Request) -> web.WebSocketResponse:
        client = web.WebSocketResponse(autoping=False)
        await client.prepare(request)
        self._clients[client] = {}
        assert request.transport is not None
        self._transports.append(request.transport)
        try:
            async for message in client:
                if message.type == WSMsgType.PING and not self.deaf:
                    self.pings += 1
                    await client.pong(message.data)
                if message.type == WSMsgType.TEXT:
                    await self._take(client, json.loads(message.data))
        finally:
            for topic in list(self._clients[client]):
                self._leave(client, topic)
            del self._clients[client]
        return client

    async def _take(self, client: web.WebSocketResponse, operation: dict[str, Any]) -> None:
        if operation["op"] == "subscribe":
            await self._subscribe(client, operation)
        elif operation["op"] == "unsubscribe":
            subscription = self._clients[client].get(operation["topic"])
            if subscription is not None:
                subscription.throttles.pop(operation.get("id"), None)
                if not subscription.throttles or operation.get("id") is None:
                    self._leave(client, operation["topic"])
        elif operation["op"] == "call_service" and not self.silent_rosapi:
            await client.send_str(json.dumps(self._call(operation)))
        with self._changed:
            self.operations.append(operation)
            self._changed.notify_all()

    async def _subscribe(self, client: web.WebSocketResponse, operation: dict[str, Any]) -> None:
        topic = operation["topic"]
        subscription = self._clients[client].setdefault(topic, _Subscription())
        subscription.throttles[operation.get("id")] = operation.get("throttle_rate", 0) / 1000
        if topic not in self._subscribers:
            there = self.advertised is None or topic in self.advertised
            if not there and "type" not in operation:
                return
            self._subscribers[topic] = self._master
        subscription.joined = True
        for text in self._latched.get(topic, {}).values():
            # The client may have left already.
            with contextlib.suppress(ConnectionResetError):
                await client.send_str(text)

    def _leave(self, client: web.WebSocketResponse, topic: str) -> None:
        del self._clients[client][topic]
        if not any(topic in topics for topics in self._clients.values()):
            self._subscribers.pop(topic, None)

    async def _deliver(self, topic: str, text: str) -> bool:
        if self._subscribers.get(topic) != self._master:
            return False
        heard = False
        # Clients come and go while one of them is sent to.
        for client, topics in list(self._clients.items()):
            if topic not in topics:
                continue
            with contextlib.suppress(ConnectionResetError):
                if topics[topic].lets_through():
                    await client.send_str(text)
                heard = True
        return heard

    def _call(self, operation: dict[str, Any]) -> dict[str, Any]:
        service = operation["service"]
        values = self._rosapi(service, operation.get("args", {}))
        answer = {"op": "service_response", "service": service, "id": operation["id"]}
        if values is None:
            return {**answer, "values": f"Service {service} does not exist", "result": False}
        return {**answer, "values": values, "result": True}

    def _rosapi(self, service: str, arguments: dict[str, Any]) -> dict[str, Any] | None:
        if self.definitions is None:
            return None
        topics = self.advertised or {}
        if service == "/rosapi/topics_and_raw_types" and not self._old:
            texts = [self.definitions.get(kind, "") for kind in topics.values()]
            return {"topics": list(topics), "types": list(topics.values()), "typedefs_full_text": texts}
        if service == "/rosapi/topic_type":
            return {"type": topics.get(arguments["topic"], "")}
        if service == "/rosapi/message_details" and arguments["type"] in self.definitions:
            found = typedefs(arguments["type"], self.definitions[arguments["type"]])
            # rosapi mistakes a char for a message, and fails.
            return None if any("char" in one["fieldtypes"] for one in found) else {"typedefs": found}
        return None


class _Subscription:
    """A client's subscription of a topic, under each id that it gave."""

    def __init__(self) -> None:
        self.throttles: dict[str | None, float] = {}
        self.joined = False
        self._sent = -math.inf

    def lets_through(self) -> bool:
        now = time.monotonic()
        if not self.joined or now - self._sent < min(self.throttles.values()):
            return False
        self._sent = now
        return True


def typedefs(kind: str, text: str) -> list[dict[str, Any]]:
    """Return rosapi's description of a type in ROS 1: constants without their type, sorted by name."""
    definition = parse(kind, text)
    found = []
    for name, fields in definition.types.items():
        if name in (TIME, DURATION):
            continue
        constants = _constants(kind, text, name)
        found.append(
            {
                "type": name,
                "fieldnames": [field.name for field in fields],
                "fieldtypes": [field.kind for field in fields],
                "fieldarraylen": [_length(field) for field in fields],
                "examples": ["" for _ in fields],
                "constnames": [constant for constant, _ in constants],
                "constvalues": [value for _, value in constants],
            }
        )
    return found


def _constants(kind: str, text: str, wanted: str) -> list[tuple[str, str]]:
    of, found = kind, []
    for line in text.splitlines():
        if line.startswith("MSG:"):
            of = line[len("MSG:") :].strip()
        elif "=" in line and not line.startswith("=") and of == wanted:
            name, value = line.split("#")[0].split("=", 1)
            found.append((name.split()[-1], value.strip()))
    return sorted(found)


def _length(field: Field) -> int:
    return -1 if field.length is None else max(field.length, 0)
