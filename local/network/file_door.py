"""The way of robots in a network to the files: presigned requests for one bucket pass, and nothing else.

Everything else of the gateway stays on loopback. The signature and its rights are the gateway's affair; but
the key must be a function's: nobody signs such an address with the owner's.
"""

from __future__ import annotations

import asyncio
import re
import ssl
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path

from aiohttp import ClientError, ClientSession, TCPConnector, web
from yarl import URL

from iort_contract.messages.files import PART_BYTES, UPLOAD_URL_S
from iort_station.page.background import BackgroundServer
from iort_station.page.places import client_of
from local.network.certificates import ServerCertificate

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
