"""The forms of PubNub's requests and answers."""

from __future__ import annotations

import json
import zlib
from urllib.parse import unquote

from aiohttp import web

from iort_contract.limits import MAX_PUBNUB_BYTES
from local.pubnub.history import Message


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
