"""A small HTTP server in PubNub's place. PubNub's unmodified SDKs use it by its ``origin``, without TLS.

It serves publish (GET and POST), subscribe (long poll, several channels, ``iort.*``), presence heartbeats and
time, on one event loop in one thread. It refuses every other feature with PubNub's errors, except channel
groups, which are always empty here."""

from __future__ import annotations

import asyncio
import json
import time
import zlib
from collections import OrderedDict, deque
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

from aiohttp import web

from iort_contract.limits import MAX_PUBNUB_BYTES
from iort_station.page.background import BackgroundServer

# The messages that PubNub's stand-in keeps, and the selection of a subscription.

# Limits of the messages kept for subscribers that are away, and so of the memory.
KEPT_A_CHANNEL = 100
KEPT_CHANNELS = 1_000
KEPT_BYTES = 64 * 1024 * 1024
MESSAGES_AN_ANSWER = 100


class Message(NamedTuple):
    """One published message; the payload is the JSON text as sent."""

    token: int
    channel: str
    publisher: str
    payload: str


class Subscription:
    """The channels of a request: plain names, and wildcards by their prefixes."""

    def __init__(self, channels: list[str]) -> None:
        self.names = {name for name in channels if not name.endswith(".*")}
        self._prefixes = {name[:-1]: name for name in channels if name.endswith(".*")}

    def match(self, channel: str) -> str | None:
        """The entry of the subscription that the channel matches; a plain name comes first."""
        if channel in self.names:
            return channel
        for prefix, wildcard in self._prefixes.items():
            if channel.startswith(prefix):
                return wildcard
        return None


class History:
    """The newest messages of each channel, within limits of messages, channels and bytes."""

    def __init__(self, *, channels: int = KEPT_CHANNELS, size_bytes: int = KEPT_BYTES) -> None:
        self._most_channels, self._most_bytes = channels, size_bytes
        self._channels: OrderedDict[str, deque[Message]] = OrderedDict()
        self._bytes = 0

    def add(self, message: Message) -> None:
        """Keep the message. At a limit the channel that was silent for longest is dropped."""
        kept = self._channels.setdefault(message.channel, deque())
        self._channels.move_to_end(message.channel)
        kept.append(message)
        self._bytes += len(message.payload)
        if len(kept) > KEPT_A_CHANNEL:
            self._bytes -= len(kept.popleft().payload)
        while len(self._channels) > self._most_channels or (
            self._bytes > self._most_bytes and len(self._channels) > 1
        ):
            _, dropped = self._channels.popitem(last=False)
            self._bytes -= sum(len(old.payload) for old in dropped)

    def after(self, cursor: int, wanted: Subscription) -> list[tuple[str, Message]]:
        """The oldest messages after the cursor, at most those of one answer, each with its match."""
        found: list[tuple[str, Message]] = []
        for channel, kept in self._channels.items():
            match = wanted.match(channel)
            if match is not None and kept[-1].token > cursor:
                found.extend((match, message) for message in kept if message.token > cursor)
        found.sort(key=lambda entry: entry[1].token)
        return found[:MESSAGES_AN_ANSWER]


# The forms of PubNub's requests and answers.


class Refusal(Exception):  # noqa: N818 - an answer, not a fault
    """A request that is answered with an error, in one of PubNub's two forms."""

    def __init__(self, status: int, message: str, service: str | None = None) -> None:
        super().__init__(message)
        self.status, self.message, self.service = status, message, service

    def body(self, token: int) -> str:
        """A list for publish, an object for every other service."""
        if self.service is None:
            return json.dumps([0, self.message, str(token)])
        return json.dumps(
            {"status": self.status, "service": self.service, "error": True, "message": self.message}
        )


async def content(request: web.BaseRequest) -> str:
    """The body of a request, inflated."""
    try:
        body = await request.read()
        if request.headers.get("Content-Encoding") == "gzip":
            # 47 accepts both headers: the Python SDK announces gzip and sends zlib.
            inflater = zlib.decompressobj(47)
            body = inflater.decompress(body, MAX_PUBNUB_BYTES)
            if inflater.unconsumed_tail:
                raise Refusal(413, "Message Too Large")
            if not inflater.eof:
                raise Refusal(400, "Invalid Encoding")
        return body.decode()
    except web.HTTPRequestEntityTooLarge:
        raise Refusal(413, "Message Too Large") from None
    except (UnicodeDecodeError, zlib.error):
        raise Refusal(400, "Invalid Encoding") from None


def unquoted(quoted: str) -> str:
    """A part of the path, unquoted."""
    try:
        return unquote(quoted, errors="strict")
    except UnicodeDecodeError:
        raise Refusal(400, "Invalid Encoding") from None


def refuse_constant(name: str) -> None:
    """Refuse NaN and Infinity, which are not JSON."""
    raise ValueError(name)


def entry(match: str, message: Message, key: str) -> str:
    """A message as subscribe answers it."""
    # Without "e": with a 0 there the JavaScript SDK takes the message for a file.
    head = {"a": "1", "f": 0, "i": message.publisher, "p": {"t": str(message.token), "r": 1}, "k": key}
    names = {"c": message.channel, "b": match}
    return f'{json.dumps(head)[:-1]},{json.dumps(names)[1:-1]},"d":{message.payload}}}'


def preflight(request: web.BaseRequest) -> dict[str, str]:
    """Any page may use it, as with PubNub, also one from another machine in the network."""
    asked = request.headers
    return {
        "Access-Control-Allow-Origin": "*",
        "Access-Control-Allow-Methods": "GET, POST, OPTIONS",
        "Access-Control-Allow-Headers": asked.get("Access-Control-Request-Headers", "*"),
        "Access-Control-Allow-Private-Network": "true",
        "Access-Control-Max-Age": "7200",
    }


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
