"""The page for a network: over TLS, behind a password, with the broker's WebSockets behind the same login."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import secrets
import ssl
import time
from collections import OrderedDict
from collections.abc import Callable
from importlib.resources import files
from string import Template
from typing import Any
from urllib.parse import parse_qs

from aiohttp import web

from iort_contract.page import HEADERS
from iort_station.page.password import Password, Tries
from iort_station.page.server import PageServer
from local.network.servers import Listen, pass_socket

# A session ends after this time without a request, and the oldest one if there are too many.
SESSION_S = 12 * 3600.0
_MOST_SESSIONS = 1_000


class Sessions:
    """Browsers that have given the password. The server's loop alone uses it."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._ends: OrderedDict[str, float] = OrderedDict()

    def begin(self) -> str:
        """A new session's secret name."""
        name = secrets.token_urlsafe(32)
        self._ends[name] = self._now() + SESSION_S
        if len(self._ends) > _MOST_SESSIONS:
            self._ends.popitem(last=False)
        return name

    def goes_on(self, name: str) -> bool:
        """Whether there is such a session; it is used now."""
        if self._ends.get(name, 0.0) < self._now():
            self._ends.pop(name, None)
            return False
        self._ends[name] = self._now() + SESSION_S
        self._ends.move_to_end(name)
        return True

    def end(self, name: str) -> None:
        """End a session."""
        self._ends.pop(name, None)

    def end_all(self) -> None:
        """End every session."""
        self._ends.clear()


# Browsers take a cookie of this name over TLS only, and for this host alone.
COOKIE = "__Host-iort"
LOGIN, LOGOUT, SOCKET = "/login", "/logout", "/mqtt"
_FORM = files("local.up").joinpath("login.html").read_text()
_STYLE = hashlib.sha256(_FORM.split("<style>")[1].split("</style>")[0].encode()).digest()
_POLICY = (
    f"default-src 'none'; style-src 'sha256-{base64.b64encode(_STYLE).decode()}'; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
_MOST_BYTES, _FORM_S = 8 * 1024, 10.0


class NetworkPage(PageServer):
    """A page's server that answers nobody without the password but with the form to give it.

    Whoever gives it may do everything that the page can do. ``gateway`` is the embedded cloud's, which
    ``trusts`` knows. Other keyword arguments are those of `PageServer`.
    """

    def __init__(
        self,
        listen: Listen,
        port: int,
        *,
        password: Password,
        gateway: str,
        trusts: ssl.SSLContext,
        **page: Any,
    ) -> None:
        super().__init__(host=listen.address, port=port, names=listen.hosts, **page)
        self._password, self._gateway, self._trusts = password, gateway, trusts
        self._authority = listen.at(port)
        self._sessions, self._tries = Sessions(), Tries()
        self._version = password.version()
        # One at a time: each takes 64 MB.
        self._checking = asyncio.Lock()
        self._sockets: dict[str, set[asyncio.Future[None]]] = {}

    @property
    def url(self) -> str:
        """The page's address in the network."""
        return f"https://{self._authority}/"

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Answer whoever is logged in; others get the form."""
        path = request.raw_path.partition("?")[0]
        if request.headers.get("Host", "").lower() != self._authority:
            # The cookie and the broker's signature are for one host.
            if request.method in {"GET", "HEAD"} and path == "/":
                return _to(self.url)
            return web.Response(status=403, text=f"this page is at {self.url}\n")
        if request.method == "POST" and path == LOGIN:
            return await self._log_in(request)
        name = request.cookies.get(COOKIE, "")
        if self._password.version() != self._version:
            self._version = self._password.version()
            self._sessions.end_all()
            self._cut(*self._sockets)
        if not self._sessions.goes_on(name):
            if path in {"/", "/index.html", LOGIN}:
                return self._form()
            return web.json_response({"error": "log in again: load this page anew"}, status=401)
        if path == LOGIN:
            return _to("/")
        if path == LOGOUT:
            # A link elsewhere cannot do so: the cookie is not sent then.
            return self._log_out(name)
        if path == SOCKET:
            return await self._socket(request, name)
        return await super().handle(request)

    async def _socket(self, request: web.BaseRequest, name: str) -> web.StreamResponse:
        # A page elsewhere could use the cookie of a browser that ignores SameSite.
        if not self._own(request):
            return web.Response(status=403, text="only this page may connect\n")
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._sockets.setdefault(name, set()).add(ended)
        try:
            return await pass_socket(request, self._gateway, self._trusts, ended)
        finally:
            self._sockets.get(name, set()).discard(ended)

    async def _log_in(self, request: web.BaseRequest) -> web.Response:
        if not self._own(request):
            return self._form("A login needs this page's own form.", 403)
        length = request.content_length
        if length is None or length > _MOST_BYTES:
            return self._form("This is no password.", 413)
        try:
            # It may come in pieces, and must not come for ever.
            body = await asyncio.wait_for(request.content.readexactly(length), _FORM_S)
        except (asyncio.TimeoutError, asyncio.IncompleteReadError):
            return self._form("The password has not arrived.", 408)
        told = parse_qs(body.decode(errors="replace")).get("password", [""])[0]
        async with self._checking:
            wait_s = self._tries.wait_s(request.remote or "")
            if wait_s:
                again = f"Too many tries. Try again in {wait_s + 0.5:.0f} s."
                return self._form(again, 429, {"Retry-After": f"{wait_s + 0.5:.0f}"})
            if not await asyncio.to_thread(self._password.is_right, told):
                return self._form("This is not the password.", 403)
        # The address gives the browser the key for what moves robots.
        answer = _to(f"/{self.invitation().removeprefix(self.url)}")
        cookie = f"{COOKIE}={self._sessions.begin()}; Path=/; Secure; HttpOnly; SameSite=Strict"
        answer.headers["Set-Cookie"] = f"{cookie}; Max-Age={SESSION_S:.0f}"
        return answer

    def _log_out(self, name: str) -> web.Response:
        self._sessions.end(name)
        self._cut(name)
        answer = _to("/")
        answer.headers["Set-Cookie"] = f"{COOKIE}=; Path=/; Secure; HttpOnly; SameSite=Strict; Max-Age=0"
        return answer

    def _cut(self, *names: str) -> None:
        for name in names:
            for ended in self._sockets.pop(name, set()):
                if not ended.done():
                    ended.set_result(None)

    def _own(self, request: web.BaseRequest) -> bool:
        """Whether a request is from this page: each POST and each WebSocket of a browser has the origin."""
        return request.headers.get("Origin", "").lower() == f"https://{self._authority}"

    def _form(
        self, error: str = "", status: int = 200, headers: dict[str, str] | None = None
    ) -> web.Response:
        return web.Response(
            status=status,
            text=Template(_FORM).substitute(error=error),
            content_type="text/html",
            headers={
                **HEADERS,
                # Without a referrer the form's origin would be "null".
                "Referrer-Policy": "same-origin",
                "Cache-Control": "no-store",
                "Content-Security-Policy": _POLICY,
                **(headers or {}),
            },
        )


def _to(place: str) -> web.Response:
    return web.Response(status=303, headers={"Location": place, "Cache-Control": "no-store"})
