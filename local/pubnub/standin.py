"""A small HTTP server in PubNub's place. PubNub's unmodified SDKs use it by its ``origin``, without TLS.

It serves publish (GET and POST), subscribe (long poll, several channels, ``iort.*``), presence heartbeats and
time, on one event loop in one thread. It refuses every other feature with PubNub's errors, except channel
groups, which are always empty here.
"""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any
from urllib.parse import quote, unquote

from aiohttp import web

from iort_contract.limits import MAX_PUBNUB_BYTES
from iort_station.page.background import BackgroundServer
from local.pubnub.history import History, Message, Subscription
from local.pubnub.protocol import Refusal, content, entry, preflight, refuse_constant, unquoted

# Longer than any request of the SDKs, so that we can answer a message that is too large.
MAX_LINE_BYTES = 4 * MAX_PUBNUB_BYTES
# Features of PubNub that change the delivery. Ignoring them would give wrong answers.
UNSUPPORTED = ("custom_message_type", "filter-expr", "meta", "norep")


class PubNubStandIn(BackgroundServer):
    """The server, in a thread of its own: ``with PubNubStandIn() as pubnub: ... pubnub.origin``.

    If keys are given, it refuses other keys. ``port=0`` takes a free port. ``poll_s`` is the longest poll:
    PubNub answers an idle one before its SDKs give up, which is after 310 s. ``write_s`` is the time that a
    subscriber has to read an answer; then it is cut off, and its SDK reconnects. The counters may be read
    from any thread: ``published`` messages, ``delivered`` messages (one for each subscriber) and ``refused``
    requests.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        publish_key: str | None = None,
        subscribe_key: str | None = None,
        *,
        poll_s: float = 280.0,
        write_s: float = 10.0,
        max_polls: int = 1_000,
    ) -> None:
        super().__init__(host, port, max_line_size=MAX_LINE_BYTES, auto_decompress=False)
        self.published = self.delivered = self.refused = 0
        self._keys = (publish_key, subscribe_key)
        self._poll_s, self._write_s, self._max_polls = poll_s, write_s, max_polls
        self._history = History()
        self._polls: dict[asyncio.Future[None], Subscription] = {}
        self._last_token = 0

    @property
    def origin(self) -> str:
        """The SDKs' setting ``origin``; they also need ``ssl`` switched off."""
        return f"{self.host}:{self.port}"

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer a request, within ``write_s`` once the answer is known."""
        messages = 0
        if request.method == "OPTIONS":
            response = web.Response(status=204, headers=preflight(request))
        else:
            try:
                messages, body = await self._route(request)
                status = 200
            except Refusal as refusal:
                self.refused += 1
                status, body = refusal.status, refusal.body(self._token())
            response = web.Response(
                status=status,
                body=body.encode(),
                headers={
                    "Access-Control-Allow-Origin": "*",
                    "Cache-Control": "no-cache",
                    "Content-Type": "text/javascript; charset=UTF-8",
                },
            )
        self.delivered += messages
        try:
            await asyncio.wait_for(_send(request, response), self._write_s)
        except (asyncio.TimeoutError, ConnectionResetError):
            if request.transport is not None:
                request.transport.abort()
        return response

    async def _route(self, request: web.BaseRequest) -> tuple[int, str]:
        """The number of messages in the answer, and the answer."""
        path = request.raw_path.partition("?")[0].split("/")[1:]
        for name in UNSUPPORTED:
            if name in request.query:
                raise Refusal(400, f"{name} is not supported by the stand-in", "Stand-in")
        match [request.method, *path]:
            case ["GET", "publish", publish_key, subscribe_key, "0", channel, _, payload]:
                self._check_keys(publish_key, subscribe_key, None)
                return 0, self._publish(request, channel, unquoted(payload))
            case ["POST", "publish", publish_key, subscribe_key, "0", channel, _]:
                self._check_keys(publish_key, subscribe_key, None)
                return 0, self._publish(request, channel, await content(request))
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
        channel = unquoted(channel)
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
        wanted = Subscription([unquoted(name) for name in channels.split(",") if name])
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
            if len(self._polls) >= self._max_polls:
                raise Refusal(429, "Too Many Requests", "Stand-in")
            # The next message that matches completes it.
            poll: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
            self._polls[poll] = wanted
            try:
                await asyncio.wait([poll], timeout=self._poll_s)
            finally:
                del self._polls[poll]
            found = self._history.after(cursor, wanted)
        token = found[-1][1].token if found else cursor
        entries = ",".join(entry(match, message, unquote(key)) for match, message in found)
        return len(found), f'{{"t":{{"t":"{token}","r":1}},"m":[{entries}]}}'

    def _token(self) -> int:
        """A timetoken: 100 ns since the epoch, 17 digits, greater than any before."""
        self._last_token = max(self._last_token + 1, time.time_ns() // 100)
        return self._last_token


async def _send(request: web.BaseRequest, response: web.Response) -> None:
    await response.prepare(request)
    await response.write_eof()
