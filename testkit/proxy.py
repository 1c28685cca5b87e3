"""A TCP proxy that imitates a bad network between a car and its broker."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

from typing_extensions import Self

PASS, REFUSE, FREEZE = "pass", "refuse", "freeze"
_CHUNK = 65536


class Proxy:
    """Listens on a port of its own, or at ``listener``, and forwards to the target. The sockets that reach it
    come from ``dial`` if that is given: those of another machine.

    ``mode`` is `PASS`, `REFUSE` (reset every connection) or `FREEZE` (keep connections open, pass no byte).
    ``latency_s`` delays every byte, each way. ``attempts`` holds the monotonic time of every attempt.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        latency_s: float = 0.0,
        listener: socket.socket | None = None,
        dial: Callable[[], socket.socket] | None = None,
    ) -> None:
        self._target, self._listener, self._dial = (host, port), listener, dial
        self.latency_s = latency_s
        self.attempts: list[float] = []
        self._mode = PASS
        self._open: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._flowing = asyncio.Event()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._changed = threading.Condition()
        self._server: asyncio.Server
        self._resetter: asyncio.Task[None] | None = None
        self.port = 0

    def __enter__(self) -> Self:
        self._thread.start()
        self._run(self._start())
        return self

    def __exit__(self, *_: object) -> None:
        self._run(self._stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @property
    def mode(self) -> str:
        """How the proxy treats connections now."""
        return self._mode

    @mode.setter
    def mode(self, mode: str) -> None:
        self._run(self._switch(mode))

    def reset(self) -> None:
        """Reset every open connection."""
        self._run(self._reset())

    def reset_every(self, seconds: float | None) -> None:
        """Reset every connection each ``seconds``; None stops that."""
        self._run(self._reset_every(seconds))

    def wait_attempts(self, count: int, seconds: float) -> bool:
        """Wait for so many connection attempts; returns whether they came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self.attempts) >= count, seconds)

    def _run(self, coroutine: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(60)

    async def _start(self) -> None:
        self._flowing.set()
        if self._listener is None:
            self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        else:
            self._server = await asyncio.start_server(self._accept, sock=self._listener)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _stop(self) -> None:
        await self._reset_every(None)
        self._server.close()
        await self._reset()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _switch(self, mode: str) -> None:
        self._mode = mode
        (self._flowing.clear if mode == FREEZE else self._flowing.set)()
        if mode == REFUSE:
            await self._reset()

    async def _reset(self) -> None:
        for writer in list(self._open):
            _abort(writer)

    async def _reset_every(self, seconds: float | None) -> None:
        if self._resetter is not None:
            self._resetter.cancel()
            self._resetter = None
        if seconds is not None:
            self._resetter = asyncio.create_task(self._resetting(seconds))

    async def _resetting(self, seconds: float) -> None:
        while True:
            await asyncio.sleep(seconds)
            await self._reset()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._changed:
            self.attempts.append(time.monotonic())
            self._changed.notify_all()
        if self._mode == REFUSE:
            _abort(writer)
            return
        self._open.add(writer)
        out: asyncio.StreamWriter | None = None
        pumps: list[asyncio.Task[None]] = []
        try:
            await self._flowing.wait()
            back, out = await self._connect()
            self._open.add(out)
            pumps = [asyncio.create_task(self._pump(*ends)) for ends in ((reader, out), (back, writer))]
            await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        except (OSError, asyncio.CancelledError):
            pass  # the target is down, or we stop: the connection ends in both cases
        finally:
            for pump in pumps:
                pump.cancel()
            for one in (writer, out):
                if one is not None:
                    self._open.discard(one)
                    _abort(one)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        if self._dial is None:
            return await asyncio.open_connection(*self._target)
        connection = await self._loop.run_in_executor(None, self._dial)
        connection.setblocking(False)
        await self._loop.sock_connect(connection, self._target)
        return await asyncio.open_connection(sock=connection)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        queue: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        sender = asyncio.create_task(self._send(queue, writer))
        try:
            while data := await reader.read(_CHUNK):
                queue.put_nowait((self._loop.time() + self.latency_s, data))
            queue.put_nowait((self._loop.time() + self.latency_s, b""))
            await sender
        except OSError:
            pass
        finally:
            sender.cancel()

    async def _send(self, queue: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        while True:
            due, data = await queue.get()
            await asyncio.sleep(max(0.0, due - self._loop.time()))
            await self._flowing.wait()
            if not data:
                return
            writer.write(data)
            await writer.drain()


def _abort(writer: asyncio.StreamWriter) -> None:
    """Close with a reset, like a router that has lost the connection."""
    connection = writer.get_extra_info("socket")
    if connection is not None and connection.fileno() >= 0:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
