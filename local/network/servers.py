"""The two servers between a cloud and its robots and browsers, and the addresses at which they listen.

`Relay` gives a browser, which does not trust the gateway's authority, the broker's WebSockets and Amazon
Cognito: on loopback, without TLS, MQTT over WebSocket at /mqtt and the two calls by which anybody gets an
identity. Their signatures and policies are the gateway's affair. `FileDoor` lets robots of a network at the
files.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
import ssl
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
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

from iort_contract.messages.files import PART_BYTES, UPLOAD_URL_S
from iort_station.page.background import BackgroundServer
from iort_station.page.places import client_of
from iort_station.page.server import on_loopback
from local.network.certificates import ServerCertificate, is_address, spelled
from local.processes import LocalError

# LISTEN= and PAGE=: an address of this machine in a network, and the names by which others reach it.

HTTPS_PORT = 443
_NAME = re.compile(r"(?=.{1,253}$)[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*")


def is_ipv6(host: str) -> bool:
    """Whether a host is an IPv6 address."""
    return ":" in host


@dataclass(frozen=True)
class Listen:
    """Where to listen, and every host that the certificate is for."""

    address: str
    hosts: tuple[str, ...]

    @classmethod
    def parse(cls, text: str, what: str) -> Listen:
        """Read ``address[,name or address...]``; raises `LocalError`, which names ``what``."""
        parts = spelled(part.strip() for part in text.split(",") if part.strip())
        if not parts or not is_address(parts[0]) or ipaddress.ip_address(parts[0]).is_unspecified:
            # A bundle must name it, and so must the certificate.
            got = parts[0] if parts else "nothing"
            raise LocalError(
                f"{what} must begin with an address of this machine, such as {what}=192.168.1.10 or "
                f"{what}=192.168.1.10,iort.lab, got {got}"
            )
        for name in parts:
            if "%" in name:
                # Such an address means another machine on each interface: no certificate can name it.
                raise LocalError(
                    f"{what} must have addresses that are the same for every car, got {name}: "
                    "take one that does not begin with fe80, such as fd00::10"
                )
        for name in parts[1:]:
            if not is_address(name) and not _NAME.fullmatch(name):
                raise LocalError(f"{what} must have names such as iort.lab after the address, got {name}")
        return cls(parts[0], parts)

    @property
    def host(self) -> str:
        """The host that others are told: the first name, or else the address."""
        return next((one for one in self.hosts if not is_address(one)), self.address)

    def at(self, port: int) -> str:
        """`host` and a port of an HTTPS server, as a URL and a browser's Host have them."""
        host = f"[{self.host}]" if is_ipv6(self.host) else self.host
        return host if port == HTTPS_PORT else f"{host}:{port}"

    def check(self, what: str) -> None:
        """Raise `LocalError` if this machine does not have the address (yet)."""
        family = socket.AF_INET6 if is_ipv6(self.address) else socket.AF_INET
        with socket.socket(family) as probe:
            try:
                probe.bind((self.address, 0))
            except OSError as error:
                raise LocalError(
                    f"{what} must be an address of this machine, got {self.address}: {error.strerror}; "
                    "`ip address` lists them"
                ) from error

    def __str__(self) -> str:
        return ",".join(self.hosts)


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


# The way of robots in a network to the files: presigned requests for one bucket pass, and nothing else.
#
# Everything else of the gateway stays on loopback. The signature and its rights are the gateway's affair; but
# the key must be a function's: nobody signs such an address with the owner's.

# "Authenticating Requests: Using Query Parameters (AWS Signature Version 4)", with a role's credentials.
_SIGNED = {
    "X-Amz-Algorithm": re.compile(r"AWS4-HMAC-SHA256"),
    "X-Amz-Credential": re.compile(r"ASIA[A-Z0-9]{16}/\d{8}/[a-z0-9-]+/s3/aws4_request"),
    "X-Amz-Date": re.compile(r"\d{8}T\d{6}Z"),
    "X-Amz-Expires": re.compile(r"\d{1,6}"),
    "X-Amz-SignedHeaders": re.compile(r"[a-z0-9;-]+"),
    "X-Amz-Security-Token": re.compile(r".+"),
    "X-Amz-Signature": re.compile(r"[0-9a-f]{64}"),
}
_METHODS = {"GET", "PUT"}
_PASSED = re.compile(
    r"host|content-length|content-type|content-md5|if-none-match|range|x-amz-(checksum|meta|sdk)-[a-z0-9-]+",
    re.IGNORECASE,
)
_ANSWERED = re.compile(r"content-(length|type|range)|etag|last-modified|x-amz-[a-z0-9-]+", re.IGNORECASE)
_CHUNK_BYTES = 256 * 1024
# A connection without a request is closed after this time.
_IDLE_S = 30.0
# So is one whose body pauses for as long.
_PART_S = 30.0
# Requests that pass at once, and those of one address. A share of the places is for addresses that have none.
_MOST, _MOST_OF_ONE, _FIRST = 32, 8, 16


class FileDoor(BackgroundServer):
    """Passes on to ``gateway``, an address such as https://127.0.0.1:4566, in a thread of its own."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        gateway: str,
        authority: Path,
        bucket: str,
        certificate: ServerCertificate,
    ) -> None:
        super().__init__(host, port, tls=certificate.context(), idle_s=_IDLE_S)
        self._gateway, self._bucket = gateway, bucket
        self._passing: Counter[str] = Counter()
        self._trusts = ssl.create_default_context(cafile=authority)

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Pass on one request for a file."""
        if not self._passes(request):
            return web.Response(status=403, text="only presigned requests for files pass here\n")
        client = client_of(request.remote or "")
        length = request.content_length
        if request.method == "PUT" and (length is None or length > PART_BYTES):
            # The gateway holds a body in memory before it judges the signature.
            return web.Response(status=413, text=f"a part of a file must have up to {PART_BYTES} bytes\n")
        if request.method == "GET" and request.body_exists:
            return web.Response(status=400, text="who gets a file sends no body\n")
        own, places = self._passing[client], _MOST - self._passing.total()
        if own >= _MOST_OF_ONE or places <= (_FIRST if own else 0):
            return web.Response(status=503, text="too many files pass at once: try again\n")
        self._passing[client] += 1
        try:
            return await asyncio.wait_for(self._pass(request), UPLOAD_URL_S)
        except asyncio.TimeoutError:
            late = f"a part must be here within {UPLOAD_URL_S} s, without a pause\n"
            return web.Response(status=408, text=late)
        finally:
            self._passing -= Counter([client])

    async def _pass(self, request: web.BaseRequest) -> web.StreamResponse:
        # The signature covers the Host that the robot sent, and path and query as they are.
        address = URL(f"{self._gateway}{request.raw_path}", encoded=True)
        headers = [(name, value) for name, value in request.headers.items() if _PASSED.fullmatch(name)]
        late = False

        async def parts() -> AsyncIterator[bytes]:
            nonlocal late
            while True:
                try:
                    part = await asyncio.wait_for(request.content.read(_CHUNK_BYTES), _PART_S)
                except asyncio.TimeoutError:
                    late = True
                    raise
                if not part:
                    return
                yield part

        body = parts() if request.method == "PUT" else None
        async with ClientSession(connector=TCPConnector(ssl=self._trusts), auto_decompress=False) as session:
            try:
                async with session.request(
                    request.method, address, data=body, headers=headers, allow_redirects=False
                ) as answer:
                    response = web.StreamResponse(
                        status=answer.status,
                        headers=[(n, value) for n, value in answer.headers.items() if _ANSWERED.fullmatch(n)],
                    )
                    await response.prepare(request)
                    async for part in answer.content.iter_chunked(_CHUNK_BYTES):
                        await response.write(part)
                    await response.write_eof()
                    return response
            except ClientError as error:
                if late:
                    raise asyncio.TimeoutError from error
                return web.Response(status=502, text=f"the files do not answer: {error}\n")

    def _passes(self, request: web.BaseRequest) -> bool:
        path, query = request.raw_path.partition("?")[0], request.query
        lowered = [name.lower() for name in query]
        return (
            request.method in _METHODS
            and path.startswith(f"/{self._bucket}/")
            and ".." not in path
            and "Authorization" not in request.headers
            and len(set(lowered)) == len(lowered)
            and all(form.fullmatch(query.get(name, "")) for name, form in _SIGNED.items())
        )
