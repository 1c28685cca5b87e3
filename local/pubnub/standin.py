"""A small HTTP server in PubNub's place. PubNub's unmodified SDKs use it by its ``origin``, without TLS.

It serves publish (GET and POST), subscribe (long poll, several channels, ``iort.*``), presence heartbeats and
time, on one event loop in one thread. It refuses every other feature with PubNub's errors, except channel
groups, which are always empty here.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import threading
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

from aiohttp import web

from iort_contract.limits import MAX_PUBNUB_BYTES
from local.pubnub.history import History, Message, Subscription
from local.pubnub.protocol import Refusal, entry, preflight, read, refuse_constant, text

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import TracebackType

    from typing_extensions import Self

# PubNub answers an idle long poll before its SDKs give up, which is after 310 s.
POLL_S = 280.0
# The time that a subscriber has to read an answer. Then it is cut off, and its SDK reconnects.
WRITE_S = 10.0
MAX_POLLS = 1_000
# Longer than any request of the SDKs, so that we can answer a message that is too large.
MAX_LINE_BYTES = 4 * MAX_PUBNUB_BYTES

# Features of PubNub that change the delivery. Ignoring them would give wrong answers.
UNSUPPORTED = ("custom_message_type", "filter-expr", "meta", "norep")


class PubNubStandIn:
    """The server, in a thread of its own: ``with PubNubStandIn() as pubnub: ... pubnub.origin``.

    If keys are given, it refuses other keys. ``port=0`` takes a free port. The counters may be read from any
    thread: ``published`` messages, ``delivered`` messages (one for each subscriber) and ``refused`` requests.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        publish_key: str | None = None,
        subscribe_key: str | None = None,
        *,
        poll_s: float = POLL_S,
    ) -> None:
        self.host, self.port = host, port
        self.published = self.delivered = self.refused = 0
        self._keys = (publish_key, subscribe_key)
        self._poll_s = poll_s
        self._history = History()
        self._polls: dict[asyncio.Future[None], Subscription] = {}
        self._last_token = 0
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop
        self._stopping: asyncio.Event

    @property
    def origin(self) -> str:
        """The SDKs' setting ``origin``; they also need ``ssl`` switched off."""
        return f"{self.host}:{self.port}"

    def start(self) -> Self:
        """Listen, and return once connections are accepted. Raises `OSError` if the port is not free."""
        if self._thread is not None:
            raise RuntimeError("the PubNub stand-in is running already")
        listening = socket.create_server((self.host, self.port))
        self.port = listening.getsockname()[1]
        started: Future[None] = Future()
        thread = threading.Thread(
            target=self._run, args=(listening, started), name="pubnub-standin", daemon=True
        )
        thread.start()
        try:
            started.result()
        except BaseException:
            thread.join()
            listening.close()
            raise
        self._thread = thread
        return self

    def stop(self) -> None:
        """Drop every connection and end the thread. A second call has no effect."""
        if self._thread is not None:
            self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join()
            self._thread = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # --- the thread ----------------------------------------------------------------------------

    def _run(self, listening: socket.socket, started: Future[None]) -> None:
        try:
            asyncio.run(self._serve(listening, started))
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    async def _serve(self, listening: socket.socket, started: Future[None]) -> None:
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        server = web.Server(
            self._handle,
            handler_cancellation=True,
            access_log=None,
            max_line_size=MAX_LINE_BYTES,
            auto_decompress=False,
        )
        runner = web.ServerRunner(server, shutdown_timeout=1)
        await runner.setup()
        try:
            await web.SockSite(runner, listening).start()
            started.set_result(None)
            await self._stopping.wait()
            # Stop accepting before dropping connections: asyncio loses one that comes while it closes.
            self._loop.remove_reader(listening)
            await _drop_connections(server)
        finally:
            await runner.cleanup()

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        try:
            status, messages, body = 200, 0, ""
            if request.method == "OPTIONS":
                return await self._write(request, web.Response(status=204, headers=preflight(request)))
            messages, body = await self._route(request)
        except Refusal as refusal:
            self.refused += 1
            status, body = refusal.status, refusal.body(self._token())
        response = web.Response(
            status=status,
            body=body.encode(),
            content_type="text/javascript",
            charset="UTF-8",
            headers={"Access-Control-Allow-Origin": "*", "Cache-Control": "no-cache"},
        )
        self.delivered += messages
        return await self._write(request, response)

    async def _write(self, request: web.BaseRequest, response: web.Response) -> web.Response:
        try:
            await asyncio.wait_for(_send(request, response), WRITE_S)
        except asyncio.TimeoutError:
            self._cut(request)
        return response

    def _cut(self, request: web.BaseRequest) -> None:
        if request.transport is not None:
            request.transport.abort()

    async def _route(self, request: web.BaseRequest) -> tuple[int, str]:
        """The number of messages in the answer, and the answer."""
        path = request.raw_path.partition("?")[0].split("/")[1:]
        for name in UNSUPPORTED:
            if name in request.query:
                raise Refusal(400, f"{name} is not supported by the stand-in", "Stand-in")
        match [request.method, *path]:
            case ["GET", "publish", publish_key, subscribe_key, "0", channel, _, payload]:
                self._check_keys(publish_key, subscribe_key, None)
                return 0, self._publish(request, channel, text(payload))
            case ["POST", "publish", publish_key, subscribe_key, "0", channel, _]:
                self._check_keys(publish_key, subscribe_key, None)
                return 0, self._publish(request, channel, await read(request))
            case ["GET", "v2", "subscribe", subscribe_key, channels, "0"]:
                self._check_keys(None, subscribe_key, "Access Manager")
                return await self._subscribe(request, subscribe_key, channels)
            case ["GET", "v2", "presence", "sub-key", subscribe_key, "channel", _, "heartbeat" | "leave"]:
                self._check_keys(None, subscribe_key, "Presence")
                return 0, '{"status":200,"message":"OK","service":"Presence"}'
            case ["GET", "time", "0"]:
                return 0, f"[{self._token()}]"
        raise Refusal(404, "Not Found", "Stand-in")

    def _check_keys(self, publish_key: str | None, subscribe_key: str, service: str | None) -> None:
        for key, expected in zip((publish_key, subscribe_key), self._keys, strict=True):
            if key is not None and expected is not None and unquote(key) != expected:
                raise Refusal(400, "Invalid Key", service)

    def _publish(self, request: web.BaseRequest, channel: str, payload: str) -> str:
        channel = text(channel)
        if not channel or any(c in ",*/:\\" or c < " " for c in channel):
            raise Refusal(400, "Invalid Channel")
        # PubNub's own formula: channel and payload as in an URL, and 100 bytes.
        if len(quote(channel + payload, safe="!~*'()")) + 100 > MAX_PUBNUB_BYTES:
            raise Refusal(413, "Message Too Large")
        try:
            json.loads(payload, parse_constant=refuse_constant)
        except (ValueError, RecursionError):
            raise Refusal(400, "Invalid JSON") from None
        message = Message(self._token(), channel, request.query.get("uuid", ""), payload)
        self._history.add(message)
        self.published += 1
        for poll, wanted in self._polls.items():
            if not poll.done() and wanted.match(channel) is not None:
                poll.set_result(None)
        return f'[1,"Sent","{message.token}"]'

    async def _subscribe(self, request: web.BaseRequest, key: str, channels: str) -> tuple[int, str]:
        wanted = Subscription([text(name) for name in channels.split(",") if name])
        try:
            cursor = int(request.query.get("tt", "0"))
        except ValueError:
            raise Refusal(400, "Invalid Timetoken", "Stand-in") from None
        if cursor <= 0:
            return 0, f'{{"t":{{"t":"{self._token()}","r":1}},"m":[]}}'
        # After the clock is set back, an old cursor would get no message until the clock catches up.
        cursor = min(cursor, self._token())
        found = self._history.after(cursor, wanted)
        if not found:
            with self._polling(wanted) as poll:
                await asyncio.wait([poll], timeout=self._poll_s)
            found = self._history.after(cursor, wanted)
        token = found[-1][1].token if found else cursor
        entries = ",".join(entry(match, message, unquote(key)) for match, message in found)
        return len(found), f'{{"t":{{"t":"{token}","r":1}},"m":[{entries}]}}'

    @contextlib.contextmanager
    def _polling(self, wanted: Subscription) -> Iterator[asyncio.Future[None]]:
        """A future that the next matching message completes."""
        if len(self._polls) >= MAX_POLLS:
            raise Refusal(429, "Too Many Requests", "Stand-in")
        poll: asyncio.Future[None] = self._loop.create_future()
        self._polls[poll] = wanted
        try:
            yield poll
        finally:
            del self._polls[poll]

    def _token(self) -> int:
        """A timetoken: 100 ns since the epoch, 17 digits, greater than any before."""
        self._last_token = max(self._last_token + 1, time.time_ns() // 100)
        return self._last_token


async def _drop_connections(server: web.Server) -> None:
    """Drop every connection, also one that `web.Server` has accepted and does not list yet."""
    for _ in range(100):  # one or two rounds suffice; asyncio.run cancels the rest after a second
        others = asyncio.all_tasks() - {asyncio.current_task()}
        if not others:
            return
        for connection in server.connections:
            if connection.transport is not None:
                connection.transport.abort()
        await asyncio.wait(others, timeout=0.01)


async def _send(request: web.BaseRequest, response: web.Response) -> None:
    await response.prepare(request)
    await response.write_eof()
