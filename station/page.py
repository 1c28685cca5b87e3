"""Serves the live page, which is built from station/web into build/web by ``npm run build``.

    with PageServer(namespace="iort", subscribe_key="sub-c-...", origin="ps.pndsn.com") as page:
        print(page.url)

The page learns where to listen from ``/config.json`` and what the fields mean from ``/fields.json``.
Neither holds a key that can publish.
"""

from __future__ import annotations

import errno
import gzip
import json
import math
import re
import socket
import socketserver
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import contract
from station.errors import StationError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from typing_extensions import Self

BUILT = Path(__file__).resolve().parent.parent / "build" / "web"
PUBNUB_ORIGIN = "ps.pndsn.com"

# An open connection without a request is given up after this long.
IDLE_S = 30.0

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".map": "application/json",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}
_KEY = re.compile(r"[A-Za-z0-9_-]{1,128}")
_ORIGIN = re.compile(r"([A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:]{2,45}\])(:[0-9]{1,5})?")


class _File(NamedTuple):
    kind: str
    body: bytes
    packed: bytes


def config(
    *,
    namespace: str,
    subscribe_key: str,
    origin: str = PUBNUB_ORIGIN,
    tls: bool = True,
    vehicles: Mapping[str, Mapping[str, float]] | None = None,
) -> dict[str, Any]:
    """What the page is told, ``/config.json``; raises `StationError` for what it must not be told.

    ``vehicles`` maps a robot to its parameters; with ``speed_to_erpm_gain`` the page shows its speed
    in m/s beside the motor's erpm.
    """
    try:
        contract.check_namespace(namespace)
        known = {contract.check_robot(robot): dict(car) for robot, car in (vehicles or {}).items()}
    except contract.ContractError as error:
        raise StationError(f"the page's configuration: {error}") from error
    if not _KEY.fullmatch(subscribe_key):
        raise StationError("the page's subscribe_key: allowed is 1 to 128 of A-Z a-z 0-9 _ -")
    if subscribe_key.startswith(("pub-c-", "sec-c-")):
        raise StationError("the page's subscribe_key is a publish or secret key, which no page may see")
    if not _ORIGIN.fullmatch(origin):
        raise StationError(f"the page's origin {origin!r}: allowed is a host, or host:port")
    for robot, car in known.items():
        gain = car.get("speed_to_erpm_gain")
        if gain is not None and (not math.isfinite(gain) or gain == 0):
            raise StationError(f"speed_to_erpm_gain of {robot} is {gain}: allowed is a number, not 0")
    return {
        "namespace": namespace,
        "subscribe_key": subscribe_key,
        "origin": origin,
        "tls": tls,
        "vehicles": known,
    }


def field_table() -> dict[str, Any]:
    """The contract's field table as the page reads it, ``/fields.json``."""
    fields = {f.name: {"unit": f.unit, "meaning": f.meaning} for f in contract.VESC_FIELDS.values()}
    faults = {str(code): name for code, name in contract.FAULTS.items()}
    return {
        "version": contract.SCHEMA_VERSION,
        "stream": contract.VESC_STREAM,
        "fields": fields,
        "faults": faults,
    }


def security_policy(*, origin: str, tls: bool) -> str:
    """The page's Content-Security-Policy: its own files, PubNub at ``origin``, and nothing else."""
    pubnub = f"{'https' if tls else 'http'}://{origin}"
    return "; ".join(
        (
            "default-src 'none'",
            "script-src 'self'",
            "style-src 'self'",
            "img-src 'self'",
            f"connect-src 'self' {pubnub}",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )


class PageServer:
    """The page's web server, in threads of its own, until the ``with`` block ends.

    It listens on loopback unless told otherwise; ``port=0`` takes a free port. Raises `StationError`
    when the page is not built, when the port is taken, and for a configuration it must not serve.
    """

    def __init__(
        self,
        *,
        namespace: str,
        subscribe_key: str,
        origin: str = PUBNUB_ORIGIN,
        tls: bool = True,
        vehicles: Mapping[str, Mapping[str, float]] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        built: Path = BUILT,
    ) -> None:
        told = config(
            namespace=namespace, subscribe_key=subscribe_key, origin=origin, tls=tls, vehicles=vehicles
        )
        self.host, self.port = host, port
        self._files = _load(built)
        self._files["/config.json"] = _json_file(told)
        self._files["/fields.json"] = _json_file(field_table())
        self._policy = security_policy(origin=origin, tls=tls)
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Where a browser on this machine finds the page."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)  # noqa: S104 (compared)
        return f"http://[{host}]:{self.port}/" if ":" in host else f"http://{host}:{self.port}/"

    def start(self) -> Self:
        """Listen, and return once the page can be asked for."""
        if self._server is not None:
            raise StationError("the page is being served already")
        try:
            self._server = _Server((self.host, self.port), self._files, self._policy)
        except (OSError, OverflowError) as error:
            where = f"{self.host} port {self.port}"
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                raise StationError(
                    f"cannot serve the page on {where}: the port is in use; choose another, or 0 for any"
                ) from error
            raise StationError(f"cannot serve the page on {where}: {error}") from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="page", daemon=True
        )
        self._thread.start()
        return self

    def stop(self) -> None:
        """Stop listening; a second call does nothing."""
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._thread.join()
            self._server.server_close()
            self._server = self._thread = None

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], files: Mapping[str, _File], policy: str) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.files, self.policy = files, policy
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        # HTTPServer's own asks the name service who we are, which can take seconds.
        socketserver.TCPServer.server_bind(self)

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """A browser that went away in the middle of an answer is no error of ours."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "iort", ""
    timeout = IDLE_S
    error_content_type = "text/plain; charset=utf-8"
    error_message_format = "%(code)d %(message)s\n"
    _COMMON: ClassVar[dict[str, str]] = {
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-cache",
    }

    def do_GET(self) -> None:
        file = self.server.files.get(self.path.partition("?")[0])
        if file is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        packed = "gzip" in self.headers.get("Accept-Encoding", "")
        body = file.packed if packed else file.body
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", file.kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Vary", "Accept-Encoding")
        if packed:
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_GET  # noqa: N815 (the library's name)

    def end_headers(self) -> None:
        for name, value in self._COMMON.items():
            self.send_header(name, value)
        self.send_header("Content-Security-Policy", self.server.policy)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 (the library's name)
        """Requests are not news."""


def _load(built: Path) -> dict[str, _File]:
    """Every file of the build by its address, so that nothing else can be asked for."""
    index = built / "index.html"
    if not index.is_file():
        raise StationError(f"the live page is not built ({index} is missing): run `npm ci && npm run build`")
    files = {
        f"/{path.relative_to(built).as_posix()}": _file(_TYPES[path.suffix], path.read_bytes())
        for path in sorted(built.rglob("*"))
        if path.is_file() and path.suffix in _TYPES
    }
    files["/"] = files["/index.html"]
    return files


def _json_file(value: Mapping[str, Any]) -> _File:
    return _file(_TYPES[".json"], json.dumps(value, allow_nan=False).encode())


def _file(kind: str, body: bytes) -> _File:
    return _File(kind, body, gzip.compress(body, 6, mtime=0))
