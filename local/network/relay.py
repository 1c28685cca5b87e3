"""The broker's WebSockets and Amazon Cognito for a browser, which does not trust the gateway's authority.

It listens on loopback without TLS, and passes on what a page needs, as it is: MQTT over WebSocket at /mqtt,
and the two calls by which anybody gets an identity. Their signatures and policies are the gateway's affair.
"""

from __future__ import annotations

import asyncio
import ssl
from urllib.parse import urlsplit

from aiohttp import (
    ClientError,
    ClientSession,
    ClientWebSocketResponse,
    TCPConnector,
    WSMsgType,
    WSServerHandshakeError,
    web,
)
from yarl import URL

from iort_station.page.background import BackgroundServer
from iort_station.page.server import on_loopback

# "Amazon Cognito Federated Identities": these two are not signed.
_TARGETS = {f"AWSCognitoIdentityService.{call}" for call in ("GetId", "GetCredentialsForIdentity")}
_CORS = {
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Allow-Headers": "content-type, x-amz-target, x-amz-user-agent",
    "Access-Control-Allow-Methods": "POST",
}

_Side = web.WebSocketResponse | ClientWebSocketResponse


class Relay(BackgroundServer):
    """Passes on to ``gateway``, an address such as https://127.0.0.1:4566, in a thread of its own."""

    def __init__(self, host: str, port: int, *, gateway: str, authority: str) -> None:
        super().__init__(host, port)
        self._gateway = gateway
        self._trusts = ssl.create_default_context(cafile=authority)

    @property
    def url(self) -> str:
        """Where a browser connects to the broker."""
        return f"ws://{self.host}:{self.port}/mqtt"

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Pass on one call, or one connection until either side ends it."""
        # Every browser sends the origin with a POST and with a WebSocket, and no script can change it.
        origin = request.headers.get("Origin")
        if origin is not None and not on_loopback(urlsplit(origin).hostname or ""):
            return web.Response(status=403, text="only a page of this machine may connect\n")
        if request.method == "OPTIONS":
            return web.Response(status=204, headers=_CORS)
        if request.path == "/mqtt":
            return await pass_socket(request, self._gateway, self._trusts)
        if request.method == "POST" and request.headers.get("X-Amz-Target") in _TARGETS:
            return await self._call(request)
        return web.Response(status=404)

    async def _call(self, request: web.BaseRequest) -> web.StreamResponse:
        kept = {name: request.headers[name] for name in ("Content-Type", "X-Amz-Target")}
        try:
            async with (
                ClientSession(connector=TCPConnector(ssl=self._trusts), auto_decompress=False) as session,
                session.post(f"{self._gateway}/", data=await request.read(), headers=kept) as answer,
            ):
                return web.Response(
                    status=answer.status,
                    body=await answer.read(),
                    headers={**_CORS, "Content-Type": answer.headers.get("Content-Type", "")},
                )
        except ClientError as error:
            return _silent(error)


async def pass_socket(
    request: web.BaseRequest, gateway: str, trusts: ssl.SSLContext, ended: asyncio.Future[None] | None = None
) -> web.StreamResponse:
    """Pass on a WebSocket of the broker's, until either side ends it, or until ``ended`` is done."""
    # The signature covers the Host that the browser sent, and the query as it is.
    address = URL(f"{gateway}{request.raw_path}", encoded=True)
    asked = [one.strip() for one in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
    headers = {"Host": request.headers["Host"]}
    try:
        async with (
            ClientSession(connector=TCPConnector(ssl=trusts)) as session,
            session.ws_connect(address, protocols=asked, headers=headers, max_msg_size=0) as there,
        ):
            here = web.WebSocketResponse(protocols=asked, max_msg_size=0)
            await here.prepare(request)
            ways = [asyncio.create_task(_pass_on(*way)) for way in ((here, there), (there, here))]
            try:
                await asyncio.wait([*ways, *([ended] if ended else [])], return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await here.close()
            return here
    except WSServerHandshakeError as refused:
        return web.Response(status=refused.status)
    except ClientError as error:
        return _silent(error)


def _silent(error: ClientError) -> web.Response:
    return web.Response(status=502, text=f"the embedded cloud does not answer: {error}\n")


async def _pass_on(source: _Side, target: _Side) -> None:
    async for message in source:
        if message.type is not WSMsgType.BINARY:
            return
        await target.send_bytes(message.data)
