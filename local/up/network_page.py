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
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, TextIO
from urllib.parse import parse_qs

from aiohttp import web
from argon2 import PasswordHasher, extract_parameters
from argon2.exceptions import InvalidHashError, VerificationError

from iort_contract.page import HEADERS
from iort_station.output import write_private
from iort_station.page.places import client_of
from iort_station.page.server import PageServer
from local.network.servers import Listen, pass_socket
from local.processes import LocalError

# The password of the page in the network, who has given it, and how often it may be tried.

LEAST_CHARACTERS = 10
_MOST_CHARACTERS = 1_000
# A session ends after this time without a request, and the oldest one if there are too many.
SESSION_S = 12 * 3600.0
_MOST_SESSIONS = 1_000
# An address may try so often at once, and once more each time these seconds have passed. So may all together;
# a share of these tries is for addresses that have not tried yet.
TRIES, TRY_S = 5, 30.0
ALL_TRIES, ALL_TRY_S = 30, 2.0
FIRST_TRIES = ALL_TRIES // 2
_MOST_ADDRESSES = 10_000
_FILE = "page-password"


class Password:
    """The hash of a password, by argon2id, in a file that only its owner reads."""

    def __init__(self, folder: Path, hasher: PasswordHasher | None = None) -> None:
        self._path, self._hasher = folder / _FILE, hasher or PasswordHasher()

    def make(self) -> str | None:
        """Make a random password unless there is one; returns a new one, which nobody can read later. Raises
        `LocalError` if the file is damaged."""
        if self._path.exists():
            self._check()
            return None
        new = secrets.token_urlsafe(12)
        self.set(new)
        return new

    def set(self, new: str) -> None:
        """Change the password; raises `LocalError` for one that is too short or too long."""
        if not LEAST_CHARACTERS <= len(new) <= _MOST_CHARACTERS:
            raise LocalError(
                f"the password must have {LEAST_CHARACTERS} to {_MOST_CHARACTERS} characters, got {len(new)}"
            )
        write_private(self._path, self._hasher.hash(new).encode())

    def is_right(self, told: str) -> bool:
        """Whether it is the password; takes a tenth of a second, so that guesses take time."""
        if len(told) > _MOST_CHARACTERS:
            return False
        try:
            return self._hasher.verify(self._path.read_text(), told)
        except (VerificationError, InvalidHashError):
            return False

    def _check(self) -> None:
        text = self._path.read_text(errors="replace")
        with suppress(InvalidHashError):
            if extract_parameters(text).hash_len == self._hasher.hash_len:
                return
        raise LocalError(
            f"{self._path} must have a hash of argon2, got {text[:40]!r}: `make up-password` sets another"
        )

    def version(self) -> int:
        """Changes with the password."""
        return self._path.stat().st_mtime_ns


def first_password(new: str, command: str, output: TextIO) -> str:
    """What is told of a password that was just made: a terminal alone is told which. Others can read what
    goes into a file or a journal."""
    if output.isatty():
        return f"password {new} (shown once; `{command}` sets another)"
    return f"password is not shown here: `{command}` sets one"


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


class Tries:
    """How often an address may still try a password."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._of_all = (float(ALL_TRIES), now())

    def wait_s(self, address: str) -> float:
        """Count a try; returns 0, or the seconds until the next one, and then it must not be made."""
        now, client = self._now(), client_of(address)
        own = _filled(self._left.get(client, (float(TRIES), now)), now, TRIES, TRY_S)
        of_all = _filled(self._of_all, now, ALL_TRIES, ALL_TRY_S)
        kept = 0 if own == TRIES else FIRST_TRIES
        wait_s = max((1 - own) * TRY_S, (1 + kept - of_all) * ALL_TRY_S, 0.0)
        if wait_s > 0:
            return wait_s
        self._left[client], self._of_all = (own - 1, now), (of_all - 1, now)
        self._left.move_to_end(client)
        if len(self._left) > _MOST_ADDRESSES:
            self._left.popitem(last=False)
        return 0.0


def _filled(left: tuple[float, float], now: float, most: int, each_s: float) -> float:
    return min(float(most), left[0] + (now - left[1]) / each_s)


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
