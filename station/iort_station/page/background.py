"""An aiohttp server in a thread of its own, for programs that are not asynchronous."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import threading
from collections.abc import AsyncIterator
from concurrent.futures import Future
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from aiohttp import web
from aiohttp.http import HttpProcessingError
from typing_extensions import Self

from iort_station.supervision import keep, keep_task


class BackgroundServer:
    """Calls `handle` for every request, from `start` to `stop` or within a ``with`` block. After an
    unexpected error it says so and listens again.

    ``port=0`` takes a free port. With ``tls`` it speaks HTTPS. A connection without a request is closed
    after ``idle_s``, or up to twice that before its first one. ``options`` are those of `aiohttp.web.Server`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        tls: ssl.SSLContext | None = None,
        idle_s: float | None = None,
        **options: Any,
    ) -> None:
        self.host, self.port = host, port
        self._tls, self._options, self._idle_s = tls, options, idle_s
        if idle_s is not None:
            self._options["keepalive_timeout"] = idle_s
        self._scheme = "http" if tls is None else "https"
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._loop: asyncio.AbstractEventLoop
        self._stopping: asyncio.Event

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer a request."""
        raise NotImplementedError

    @asynccontextmanager
    async def beside(self) -> AsyncIterator[None]:
        """What runs in the server's loop as long as it serves; nothing by default."""
        yield

    def start(self) -> Self:
        """Listen, and return once connections are accepted. Raises `OSError` if the port is not free."""
        if self._thread is not None:
            raise RuntimeError("the server is running already")
        listening = self._listen()
        self._ended.clear()
        started: Future[None] = Future()
        self._thread = threading.Thread(
            target=self._run, args=(listening, started), name=type(self).__name__, daemon=True
        )
        self._thread.start()
        try:
            started.result()
        except BaseException:
            self.stop()
            raise
        return self

    def _listen(self) -> socket.socket:
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        both = self.host == "::" and socket.has_dualstack_ipv6()
        listening = socket.create_server((self.host, self.port), family=family, dualstack_ipv6=both)
        self.port = listening.getsockname()[1]
        return listening

    def _run(self, listening: socket.socket, started: Future[None]) -> None:
        first: list[socket.socket] = [listening]

        def serve() -> None:
            try:
                with first.pop() if first else self._listen() as door:
                    asyncio.run(self._serve(door, started))
            except Exception as error:
                if started.done():
                    raise
                # Whoever starts it gets this one.
                started.set_exception(error)

        keep(type(self).__name__, serve, self._ended)

    def stop(self) -> None:
        """Drop every connection and end the thread. A second call has no effect."""
        if self._thread is not None:
            self._ended.set()
            # Between two starts there is no loop.
            with suppress(AttributeError, RuntimeError):
                self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join()
            self._thread = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_error: object) -> None:
        self.stop()

    async def _serve(self, listening: socket.socket, started: Future[None]) -> None:
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        if self._ended.is_set():
            return
        logger = logging.getLogger(f"aiohttp.server.{type(self).__name__}")
        logger.addFilter(_is_our_fault)
        requested: set[Any] = set()

        async def handle(request: web.BaseRequest) -> web.StreamResponse:
            if self._idle_s is not None:
                requested.add(request.protocol)
            return await self.handle(request)

        server = web.Server(
            handle, handler_cancellation=True, access_log=None, logger=logger, **self._options
        )
        runner = web.ServerRunner(server, shutdown_timeout=1)
        await runner.setup()
        await web.SockSite(runner, listening, ssl_context=self._tls).start()
        closing = None
        if self._idle_s is not None:
            closing = asyncio.create_task(self._close_silent(server, requested, self._idle_s))
        try:
            async with self.beside():
                if not started.done():
                    started.set_result(None)
                await self._stopping.wait()
        finally:
            if closing is not None:
                closing.cancel()
            # Stop accepting before dropping connections: asyncio loses one that comes while it closes.
            self._loop.remove_reader(listening)
            await _drop_connections(server)
            await runner.cleanup()

    async def _close_silent(self, server: web.Server, requested: set[Any], idle_s: float) -> None:
        """Close connections without a first request, for which aiohttp waits for ever."""
        before: set[Any] = set()

        async def look() -> None:
            nonlocal before
            while True:
                await self.pause(idle_s)
                now = set(server.connections)
                requested.intersection_update(now)
                for connection in (before & now) - requested:
                    if connection.transport is not None:
                        connection.transport.abort()
                before = now

        await keep_task(f"{type(self).__name__}'s closing of silent connections", look)

    async def pause(self, seconds: float) -> None:
        """The time between two looks for silent connections."""
        await asyncio.sleep(seconds)


def tls_context(path: Path) -> ssl.SSLContext:
    """A server's context with the key and the certificate of a file, which takes over by itself what is
    written there later. Raises `OSError`, also for what is no certificate."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(path)
    loaded = path.stat().st_mtime_ns

    def look(_connection: ssl.SSLObject, _name: str | None, context: ssl.SSLContext) -> None:
        nonlocal loaded
        # This connection has the old one still. An error here would end it.
        with suppress(OSError):
            found = path.stat().st_mtime_ns
            if found != loaded:
                context.load_cert_chain(path)
                loaded = found

    # OpenSSL calls it at every handshake, whether the client names a server or not.
    context.sni_callback = look
    return context


def _is_our_fault(record: logging.LogRecord) -> bool:
    """Whether a fault is ours: aiohttp logs a traceback for malformed requests too, after its answer 400."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


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
