"""The door of the bridge: who may connect, how much one client may send, and what becomes of it.

The protocol has no login, so a key stands in the address: ``ws://127.0.0.1:8765/?key=...``. A page of the
internet can connect to this machine from the operator's browser, so the door looks at the page's origin.
What a client publishes goes to the wheel, never to the sdk behind the door; everything else passes.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import secrets
import ssl
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Protocol
from urllib.parse import urlsplit

from aiohttp import (
    ClientError,
    ClientSession,
    ClientWebSocketResponse,
    WSCloseCode,
    WSMsgType,
    web,
)

from iort_station.output import one_line
from iort_station.page.background import BackgroundServer
from iort_station.page.password import Password, Tries
from iort_station.page.places import client_of
from iort_station.page.server import on_loopback

_log = logging.getLogger("iort")
PROTOCOL = "foxglove.sdk.v1"
# The oldest name of the protocol, whose clients are told what to do.
_OLD_PROTOCOL = "foxglove.websocket.v1"
# Foxglove's web application, and the desktop's programs, whose pages are files.
ORIGINS = ("https://app.foxglove.dev", "file://")
MOST_CLIENTS = 16
MOST_BYTES = 256 * 1024
# More is not even read: aiohttp ends the connection.
_MOST_READ_BYTES = 32 * MOST_BYTES
# A client may send so many messages at once, and so many a second; pings count, too.
_BURST, _PER_S = 1_000, 200
# Each channel of a message gets an answer; more are not even looked at.
_MOST_CHANNELS = 64
# A client that does not answer for so long is gone.
_HEARTBEAT_S = 20.0
# The same words about the same client are said so seldom.
_SAID_S, _MOST_SAID = 60.0, 256
# What a client sends: the first byte of a binary message.
_PUBLISHED = 1


class Wheel(Protocol):
    """Takes what clients publish; every method returns why it cannot be taken, or nothing."""

    def advertise(self, client: int, channel: Any) -> str:
        """A client wants to publish."""

    def unadvertise(self, client: int, channel: Any) -> None:
        """A client does not want to any longer."""

    def publish(self, client: int, data: bytes) -> str:
        """A client's message: the channel's id in four bytes, and the message."""

    def gone(self, client: int) -> None:
        """A client has ended."""


# Takes the key that a client gives, and its address; returns HTTP's status and why it may not come in.
Admission = Callable[[str, str], "tuple[int, str] | None"]


def one_key(key: str) -> Admission:
    """Admit who has this key."""

    def admission(told: str, _address: str) -> tuple[int, str] | None:
        if hmac.compare_digest(told.encode(errors="replace"), key.encode()):
            return None
        return 401, "the address must end in /?key= and the key that `iort bridge` printed"

    return admission


class ByPassword:
    """Admits who has the password, as the page does: each guess takes time, and an address has few."""

    def __init__(self, password: Password) -> None:
        self._password, self._tries = password, Tries()
        # A client that connects again with what was right is not a guess. Kept as a digest alone.
        self._secret, self._right = secrets.token_bytes(32), (0, b"")
        # One at a time: each takes 64 MB.
        self._lock = threading.Lock()

    def __call__(self, told: str, address: str) -> tuple[int, str] | None:
        """As `Admission`."""
        with self._lock:
            try:
                return self._refusal(told, address)
            except OSError as error:
                return 503, f"the password cannot be read ({error}): start `iort bridge` again"

    def _refusal(self, told: str, address: str) -> tuple[int, str] | None:
        digest = hmac.digest(self._secret, told.encode(errors="replace"), "sha256")
        version, right = self._right
        now = self._password.version()
        if version == now and hmac.compare_digest(digest, right):
            return None
        if wait_s := self._tries.wait_s(address):
            return 429, f"too many tries: try again in {wait_s + 0.5:.0f} s"
        if not self._password.is_right(told):
            return 401, "the address must end in /?key= and the password"
        self._right = now, digest
        return None


def everybody(_told: str, _address: str) -> tuple[int, str] | None:
    """Admit everybody who reaches the address."""
    return None


class Door(BackgroundServer):
    """Passes clients on to ``inner``, the sdk's address, from `start` to `stop`.

    ``admits`` may take its time: it runs in a thread. ``origins`` are allowed beside `ORIGINS` and pages of
    this machine.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        inner: str,
        admits: Admission = everybody,
        origins: Iterable[str] = (),
        wheel: Wheel | None = None,
        context: ssl.SSLContext | None = None,
        most_clients: int = MOST_CLIENTS,
    ) -> None:
        super().__init__(host, port, tls=context, idle_s=60.0)
        self._inner, self._admits, self._wheel = inner, admits, wheel
        self._origins = {*ORIGINS, *(origin.rstrip("/").lower() for origin in origins)}
        self._most, self._clients = most_clients, set[int]()
        self._said: OrderedDict[tuple[str, str], float] = OrderedDict()

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Pass a client on until either side ends."""
        address = client_of(request.remote or "")
        if (refusal := await self._refusal(request, address)) is not None:
            status, reason = refusal
            self._say(address, reason)
            return web.Response(status=status, text=f"{reason}\n")
        client = secrets.randbits(32)
        self._clients.add(client)
        try:
            return await self._pass(request, client, address)
        except (ClientError, OSError) as error:
            return web.Response(status=502, text=f"the bridge does not answer: {error}\n")
        finally:
            self._clients.discard(client)
            if self._wheel is not None:
                self._wheel.gone(client)

    async def _refusal(self, request: web.BaseRequest, address: str) -> tuple[int, str] | None:
        """Why a client may not come in, with HTTP's status; None if it may."""
        if request.headers.get("Upgrade", "").lower() != "websocket":
            return 426, "this is no page: open its address in Foxglove, as a `Foxglove WebSocket`"
        origin = request.headers.get("Origin")
        if origin is not None and not self._accepts(origin):
            named = one_line(origin[:100])
            return 403, f"a page of {named} may not connect: `iort bridge --origin {named}` allows it"
        offered = [one.strip() for one in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        if PROTOCOL not in offered:
            got = one_line(", ".join(filter(None, offered))[:100]) or "none"
            old = ": this client is too old" if _OLD_PROTOCOL in offered else ""
            return 400, f"the WebSocket's protocol must be {PROTOCOL}, got {got}{old}"
        if (
            refusal := await asyncio.to_thread(self._admits, request.query.get("key", ""), address)
        ) is not None:
            return refusal
        # Nothing is awaited from here until the client is counted.
        if len(self._clients) >= self._most:
            return 503, f"{self._most} clients are connected already: end one of them"
        return None

    def _accepts(self, origin: str) -> bool:
        known = origin.rstrip("/").lower() if origin != "file://" else origin
        if known in self._origins:
            return True
        try:
            return on_loopback(urlsplit(origin).hostname or "")
        except ValueError:
            return False

    async def _pass(self, request: web.BaseRequest, client: int, address: str) -> web.StreamResponse:
        async with (
            ClientSession() as session,
            session.ws_connect(self._inner, protocols=[PROTOCOL], max_msg_size=0) as there,
        ):
            # Pings are answered here, where they are counted.
            here = web.WebSocketResponse(
                protocols=[PROTOCOL],
                max_msg_size=_MOST_READ_BYTES,
                heartbeat=_HEARTBEAT_S,
                compress=False,
                autoping=False,
            )
            await here.prepare(request)
            ways = [
                asyncio.create_task(_pass_back(there, here)),
                asyncio.create_task(self._pass_in(here, there, client)),
            ]
            try:
                done, _ = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in done:
                    if (reason := await way) is not None:
                        code, text = reason
                        self._say(address, text)
                        await here.close(code=code, message=text.encode()[:120])
            finally:
                for way in ways:
                    way.cancel()
                # A client that is killed may end both: the other one's error is no news.
                await asyncio.gather(*ways, return_exceptions=True)
                await here.close()
            return here

    async def _pass_in(
        self, here: web.WebSocketResponse, there: ClientWebSocketResponse[bool], client: int
    ) -> tuple[int, str] | None:
        """What the client sends; returns why it is cut off, with the close code."""
        left, at_s = float(_BURST), time.monotonic()
        async for message in here:
            now_s = time.monotonic()
            left, at_s = min(_BURST, left + (now_s - at_s) * _PER_S) - 1, now_s
            if message.type in {WSMsgType.TEXT, WSMsgType.BINARY} and len(message.data) > MOST_BYTES:
                return WSCloseCode.MESSAGE_TOO_BIG, f"a message must have at most {MOST_BYTES} bytes"
            if left < 0:
                return WSCloseCode.POLICY_VIOLATION, f"a client may send {_PER_S} messages a second"
            if message.type is WSMsgType.PING:
                await here.pong(message.data)
            elif message.type is WSMsgType.TEXT:
                told = _object(message.data)
                if told is None:
                    return WSCloseCode.INVALID_TEXT, "a text message must be an object of JSON"
                if self._wheel is None or not await self._taken(self._wheel, here, client, told):
                    await there.send_str(message.data)
            elif message.type is WSMsgType.BINARY:
                if self._wheel is not None and message.data[:1] == bytes([_PUBLISHED]):
                    await _answer(here, self._wheel.publish(client, message.data[1:]))
                else:
                    await there.send_bytes(message.data)
        return None

    async def _taken(
        self, wheel: Wheel, here: web.WebSocketResponse, client: int, told: dict[str, Any]
    ) -> bool:
        """Whether a message is about publishing, which the wheel takes."""
        if told.get("op") == "advertise":
            for channel in _list(told.get("channels"))[:_MOST_CHANNELS]:
                await _answer(here, wheel.advertise(client, channel))
        elif told.get("op") == "unadvertise":
            for channel in _list(told.get("channelIds"))[:_MOST_CHANNELS]:
                wheel.unadvertise(client, channel)
        else:
            return False
        return True

    def _say(self, address: str, reason: str) -> None:
        """Log why a client was refused or cut off; not each time, because it may come again at once."""
        now_s, key = time.monotonic(), (address, reason)
        if now_s - self._said.get(key, -_SAID_S) < _SAID_S:
            return
        self._said[key] = now_s
        self._said.move_to_end(key)
        if len(self._said) > _MOST_SAID:
            self._said.popitem(last=False)
        _log.warning("a client of the bridge at %s: %s", address, reason)


async def _pass_back(there: ClientWebSocketResponse[bool], here: web.WebSocketResponse) -> None:
    async for message in there:
        if message.type is WSMsgType.BINARY:
            await here.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT:
            await here.send_str(message.data)


async def _answer(here: web.WebSocketResponse, problem: str) -> None:
    """Tell a client what is wrong, if something is."""
    if problem:
        await here.send_str(json.dumps({"op": "status", "level": 2, "message": problem, "id": "publish"}))


def _object(text: str) -> dict[str, Any] | None:
    try:
        told = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return told if isinstance(told, dict) else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []
