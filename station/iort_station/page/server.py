"""Serves the live page on this machine.

    with PageServer(namespace="iort", subscribe_key="sub-c-...", origin="ps.pndsn.com") as page:
        print(page.url)

The page reads from ``/config.json`` where to listen; it holds no key that can publish or act.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import ipaddress
import json
import logging
import re
import secrets
import ssl
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from aiohttp import ETag, web
from typing_extensions import Self

from iort_contract import page
from iort_contract.cloud import PUBNUB
from iort_contract.messages.page import Admitted
from iort_station.errors import StationError
from iort_station.page.background import BackgroundServer
from iort_station.page.invitations import COMMAND, answer, listening
from iort_station.page.page import BUILT, DRIVE, TYPES, built_files, config
from iort_station.page.places import ACTING, READING, WRITING, Busy, Work, client_of
from iort_station.page.requests import Body, Handler, as_json, outcome, packed, takes_gzip

# Writes a file into a folder and returns it.
Download = Callable[[Mapping[str, str], Path], Path]
_log = logging.getLogger("iort")

# A connection without a request is closed after this time.
IDLE_S = 30.0
# Where a browser gets the key.
ADMISSION = "/key.json"
CONFIG = "/config.json"
_CHUNK_BYTES = 256 * 1024
# A body must be here within this time, and who downloads must take a part within the other.
BODY_S, PART_S = 10.0, 60.0
# They stop and drive robots, or a page cannot begin without them. Each has a lane of its own, so that it
# waits for nothing but its like.
FIRST = frozenset({"/stop.json", f"/{DRIVE}.json", "/view.json", "/motion.json", "/socket.json", ADMISSION})
# They decode what robots have sent.
FEW = frozenset({"/incident_picture.json"})
# Invitations that nobody has used yet; a further one ends the oldest.
_MOST_TOKENS = 64
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]]+)(:[0-9]*)?")


class PageServer(BackgroundServer):
    """The page's web server, in threads of its own.

    It listens on loopback by default. ``answers`` maps a name to the function that answers ``/<name>.json``
    from the parameters of the request. ``open_actions`` change something that everybody who reaches the page
    may change; they need a POST with the page's own origin. ``actions`` need the server's key, too: a browser
    gets it once for each `invitation`, and ``admitted`` is then called with the next one. ``downloads`` maps
    a name to the function that writes the file ``/<name>``. ``broker`` is the broker's address for
    WebSockets, without a path. The server accepts a Host that is localhost, an address or one of ``names``,
    and no other. In the folder ``invitations`` it gives its own user an `invitation` when asked. A body must
    come within ``body_s``. With a ``context`` it speaks HTTPS. The other arguments are those of `config`.
    Raises `StationError` if the page is not built, if the port is in use, and for a configuration that it
    must not serve.
    """

    def __init__(
        self,
        *,
        broker: str = "",
        answers: Mapping[str, Handler] | None = None,
        actions: Mapping[str, Handler] | None = None,
        open_actions: Mapping[str, Handler] | None = None,
        downloads: Mapping[str, Download] | None = None,
        admitted: Callable[[str], None] = lambda _address: None,
        host: str = "127.0.0.1",
        port: int = 0,
        names: Iterable[str] = (),
        built: Path = BUILT,
        invitations: Path | None = None,
        body_s: float = BODY_S,
        context: ssl.SSLContext | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(host, port, tls=context, idle_s=IDLE_S)
        self._answers = {f"/{name}.json": answer for name, answer in (answers or {}).items()}
        keyed, free = actions or {}, open_actions or {}
        self._actions = {f"/{name}.json": action for name, action in {**free, **keyed}.items()}
        self._keyed = frozenset(f"/{name}.json" for name in keyed)
        self._downloads = {f"/{name}": download for name, download in (downloads or {}).items()}
        # No file has the key, because every user of this machine can read the files.
        self._key = secrets.token_urlsafe(32)
        self._tokens: deque[str] = deque(maxlen=_MOST_TOKENS)
        self._invitations = invitations if keyed else None
        self._body_s = body_s
        self._admitted = admitted
        self._names = frozenset(name.lower() for name in ("localhost", host, *names))
        known = config(
            **settings,
            answers=bool(answers),
            actions=[*free, *keyed],
            keyed=keyed,
            invite=COMMAND if keyed and invitations else "",
        )
        elsewhere = [broker] if broker else []
        if known["live"] == PUBNUB:
            elsewhere.insert(0, page.pubnub_address(known["origin"], tls=known["tls"]))
        if known["identity"]:
            elsewhere.append(known["identity"]["endpoint"])
        # Only these can be requested: no path reaches the file system.
        files = _packed_files(built)
        self._files = {**files, "/": files["/index.html"], CONFIG: as_json(known)}
        self._work: Work
        self._headers = {
            **page.HEADERS,
            "Cache-Control": "no-cache",
            "Content-Security-Policy": page.security_policy(*elsewhere),
            "Server": "iort",
            "Vary": "Accept-Encoding",
        }

    @property
    def url(self) -> str:
        """The page's address for a browser on this machine."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)  # noqa: S104 - compared
        return f"{self._scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def invitation(self, view: str = "#/") -> str:
        """An address that gives one browser the key, once; the page's plain address if no action needs it."""
        if not self._keyed:
            return self.url + view
        token = secrets.token_urlsafe(32)
        self._tokens.append(token)
        # What follows the # stays in the browser; it is in no log.
        return f"{self.url}{view}?{page.INVITATION}={token}"

    def start(self) -> Self:
        """Listen, and return once the page can be requested."""
        where = f"cannot serve the page on {self.host} port {self.port}"
        if not 0 <= self.port <= 65_535:
            raise StationError(f"{where}: the port must be 0 to 65535")
        try:
            return super().start()
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise StationError(f"{where}: the port is in use; choose another, or 0 for any") from error
            raise StationError(f"{where}: {error}") from error

    @asynccontextmanager
    async def beside(self) -> AsyncIterator[None]:
        """Give invitations to who serves the page."""
        # A loop that begins again leaves the places of the last one to its threads.
        self._work = Work(FIRST, FEW)
        if self._invitations is None:
            yield
            return
        with ExitStack() as stack:
            try:
                door = stack.enter_context(listening(self._invitations, self.port))
            except (OSError, StationError) as error:
                _log.warning("`%s` does not know this page: %s", COMMAND, error)
                yield
                return
            server = await asyncio.start_unix_server(
                lambda reader, writer: answer(reader, writer, self.url, self.invitation), sock=door
            )
            async with server:
                yield

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer with a file, or with the result of one of ``answers``."""
        if not self._accepts(request.headers.get("Host", "")):
            return self._refusal(
                request, 403, "this server answers to localhost, to addresses and to what --name says"
            )
        path = request.raw_path.partition("?")[0]
        if request.method == "POST" and path == ADMISSION and self._keyed:
            return await self._act(request, path, self._admit)
        if request.method == "POST" and path in self._actions:
            return await self._act(request, path, self._actions[path], keyed=path in self._keyed)
        if request.method not in {"GET", "HEAD"}:
            return self._response(request, packed(TYPES[".txt"], b"405 Method Not Allowed\n"), 405)
        answer = self._answers.get(path)
        if answer is not None:
            return await self._answer(request, path, answer, dict(request.query), READING)
        if path in self._downloads:
            return await self._download(request, path)
        file = self._files.get(path)
        if file is None:
            return self._response(request, packed(TYPES[".txt"], b"404 Not Found\n"), 404)
        return self._tagged(request, file)

    def _tagged(self, request: web.BaseRequest, body: Body) -> web.Response:
        """The body, unless the browser has it already."""
        response = self._response(request, body, 200)
        # Weak, because the same content may be sent with or without gzip.
        response.etag = ETag(body.etag, is_weak=True)
        if any(known.value in {body.etag, "*"} for known in request.if_none_match or ()):
            response.set_status(304)
            response.body = None
        return response

    async def _answer(
        self,
        request: web.BaseRequest,
        path: str,
        answer: Handler,
        parameters: Mapping[str, str],
        lane: str,
    ) -> web.Response:
        """The answer, in a place of its lane; what yields waits without one."""
        client = client_of(request.remote or "")
        try:
            result = await self._work.do(lambda: outcome(lambda: answer(parameters)), lane, client, path)
            if not isinstance(result, tuple):
                waiting = result
                result = await self._work.until(lambda: outcome(lambda: next(waiting)), lane, client, path)
        except Busy as busy:
            return self._busy(request, busy)
        status, body = result
        if lane == READING and status == 200:
            return self._tagged(request, body)
        return self._response(request, body, status)

    async def _download(self, request: web.BaseRequest, path: str) -> web.StreamResponse:
        parameters, download = dict(request.query), self._downloads[path]
        with TemporaryDirectory(prefix="iort-download-") as folder:
            try:
                client = client_of(request.remote or "")
                work = partial(download, parameters, Path(folder))
                written = await self._work.do(lambda: outcome(work), WRITING, client, path)
            except Busy as busy:
                return self._busy(request, busy)
            if isinstance(written, tuple):
                return self._response(request, written[1], written[0])
            named = {"Content-Disposition": f'attachment; filename="{written.name}"'}
            kind = {"Content-Type": "application/octet-stream"}
            response = web.StreamResponse(headers={**self._headers, **kind, **named})
            file = await asyncio.to_thread(written.open, "rb")
            with file:
                response.content_length = written.stat().st_size
                await response.prepare(request)
                while request.method == "GET" and (part := await asyncio.to_thread(file.read, _CHUNK_BYTES)):
                    await asyncio.wait_for(response.write(part), PART_S)
            await response.write_eof()
            return response

    def _busy(self, request: web.BaseRequest, busy: Busy) -> web.Response:
        response = self._refusal(request, 429 if busy.own else 503, f"{busy}: try again")
        response.headers["Retry-After"] = "1"
        return response

    def _admit(self, parameters: Mapping[str, str]) -> Admitted:
        """The key, for a token that was not used before; or whether a kept key is still the server's."""
        token = parameters.get("token", "")
        if self._is_key(token):
            return {"key": self._key}
        try:
            self._tokens.remove(token)
        except ValueError as error:
            known = "this address was used before, or is of an earlier start of the server"
            raise StationError(f"{known}: {self._another()}") from error
        self._admitted(self.invitation())
        return {"key": self._key}

    def _another(self) -> str:
        """What gives a browser the key."""
        return f"open a link of `{COMMAND}`" if self._invitations else "open the one in the server's terminal"

    def _is_key(self, key: str) -> bool:
        return secrets.compare_digest(key.encode(errors="surrogateescape"), self._key.encode())

    async def _act(
        self, request: web.BaseRequest, path: str, action: Handler, *, keyed: bool = False
    ) -> web.StreamResponse:
        """Answer with the result of an action; its parameters are texts in a JSON object."""
        # Every browser sends the origin with a POST, and no script can change it.
        origin = urlsplit(request.headers.get("Origin", "")).netloc
        if origin.lower() != request.headers["Host"].lower():
            return self._refusal(request, 403, "an action needs this page's own origin")
        if keyed and not self._is_key(request.headers.get(page.KEY_HEADER, "")):
            return self._refusal(request, 403, f"this browser may only look: {self._another()}")
        # A browser sends this type to another origin only after a question that is never answered here.
        if request.content_type != TYPES[".json"]:
            return self._refusal(request, 415, "an action needs a body of application/json")
        try:
            parameters = json.loads(await asyncio.wait_for(request.text(), self._body_s))
        except asyncio.TimeoutError:
            late = self._refusal(request, 408, "the body must be here sooner")
            late.force_close()
            return late
        except (ValueError, LookupError, RecursionError):  # also of an unknown charset
            parameters = None
        if not isinstance(parameters, dict) or not all(
            isinstance(value, str) for value in parameters.values()
        ):
            return self._refusal(request, 400, "the body must be an object of texts")
        return await self._answer(request, path, action, parameters, ACTING)

    def _accepts(self, host: str) -> bool:
        """Whether a request's Host is ours.

        In DNS rebinding, a page elsewhere has its own name point here, to read the keys and the fleet's data.
        Its requests carry that name, never an address.
        """
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        try:
            ipaddress.ip_address(match[1].strip("[]"))
        except ValueError:
            return match[1].lower() in self._names
        return True

    def _refusal(self, request: web.BaseRequest, status: int, reason: str) -> web.Response:
        return self._response(request, as_json({"error": reason}), status)

    def _response(self, request: web.BaseRequest, body: Body, status: int) -> web.Response:
        headers, content = {**self._headers, "Content-Type": body.kind}, body.plain
        if takes_gzip(request.headers.get("Accept-Encoding", "")):
            headers, content = {**headers, "Content-Encoding": "gzip"}, body.packed
        return web.Response(body=content, status=status, headers=headers)


@functools.cache
def _packed_files(built: Path) -> Mapping[str, Body]:
    """The page's files by their paths: a process may serve several pages, and packs them once."""
    return {
        f"/{name}": packed(TYPES[Path(name).suffix], content) for name, content in built_files(built).items()
    }


def on_loopback(host: str) -> bool:
    """Whether a server on this address answers to this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
