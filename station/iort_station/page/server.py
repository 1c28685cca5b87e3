"""Serves the live page on this machine.

    with PageServer(namespace="iort", subscribe_key="sub-c-...", origin="ps.pndsn.com") as page:
        print(page.url)

The page learns where to listen from ``/config.json`` and what the fields mean from ``/fields.json``.
Neither holds a key that can publish.
"""

from __future__ import annotations

import errno
import gzip
import ipaddress
import json
import math
import re
import socket
import socketserver
import threading
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from botocore.exceptions import BotoCoreError, ClientError
from typing_extensions import Self

from iort_contract.limits import ContractError
from iort_contract.page import HEADERS, PUBNUB_ORIGIN, security_policy
from iort_station.errors import StationError
from iort_station.page.page import BUILT, TYPES, built_files, config, field_table

Answer = Callable[[Mapping[str, str]], Mapping[str, Any]]

# An open connection without a request is given up after this long.
IDLE_S = 30.0
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^:\[\]]+)(:[0-9]*)?")


class _File(NamedTuple):
    kind: str
    body: bytes
    packed: bytes


class PageServer:
    """The page's web server, in threads of its own, until the ``with`` block ends.

    It listens on loopback unless told otherwise; ``port=0`` takes a free port. ``answers`` maps a name to
    what answers ``/<name>.json`` from the parameters of the request. It answers to localhost, to addresses
    and to ``names``, by which else it is reached, and to no other Host. Raises `StationError`
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
        token: str = "",
        answers: Mapping[str, Answer] | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        names: Iterable[str] = (),
        built: Path = BUILT,
    ) -> None:
        told = config(
            namespace=namespace,
            subscribe_key=subscribe_key,
            origin=origin,
            tls=tls,
            vehicles=vehicles,
            token=token,
            answers=bool(answers),
        )
        self._answers = dict(answers or {})
        self.host, self.port = host, port
        self._names = frozenset(name.lower() for name in ("localhost", host, *names))
        self._files = _load(built)
        self._files["/config.json"] = _json_file(told)
        self._files["/fields.json"] = _json_file(field_table())
        self._policy = security_policy(origin=origin, tls=tls)
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Where a browser on this machine finds the page."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)  # noqa: S104 - compared
        return f"http://[{host}]:{self.port}/" if ":" in host else f"http://{host}:{self.port}/"

    def start(self) -> Self:
        """Listen, and return once the page can be asked for."""
        if self._server is not None:
            raise StationError("the page is being served already")
        try:
            self._server = _Server(
                (self.host, self.port), self._names, self._files, self._answers, self._policy
            )
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

    def __init__(
        self,
        address: tuple[str, int],
        names: frozenset[str],
        files: Mapping[str, _File],
        answers: Mapping[str, Answer],
        policy: str,
    ) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self.names, self.files, self.answers, self.policy = names, files, answers, policy
        super().__init__(address, _Handler)

    def server_bind(self) -> None:
        # HTTPServer's own asks the name service who we are, which can take seconds.
        socketserver.TCPServer.server_bind(self)

    def answers_to(self, host: str) -> bool:
        """Whether a request's Host is ours. An address is: a page elsewhere that has its own name point here,
        and would read the keys and the fleet's data, comes with that name."""
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        try:
            ipaddress.ip_address(found[1].strip("[]"))
        except ValueError:
            return found[1].lower() in self.names
        return True

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """A browser that went away in the middle of an answer is no error of ours."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "iort", ""
    timeout = IDLE_S
    error_content_type = "text/plain; charset=utf-8"
    error_message_format = "%(code)d %(message)s\n"

    def do_GET(self) -> None:
        if not self.server.answers_to(self.headers.get("Host", "")):
            refused = "this server answers to localhost, to addresses and to what --name says"
            self._send(HTTPStatus.FORBIDDEN, _json_file({"error": refused}))
            return
        path, _, query = self.path.partition("?")
        answer = self.server.answers.get(path.removeprefix("/").removesuffix(".json"))
        if answer is not None and path.endswith(".json"):
            self._answer(answer, dict(parse_qsl(query)))
            return
        file = self.server.files.get(path)
        if file is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send(HTTPStatus.OK, file)

    def _answer(self, answer: Answer, parameters: Mapping[str, str]) -> None:
        try:
            status, value = HTTPStatus.OK, answer(parameters)
        except (StationError, ContractError) as error:
            status, value = HTTPStatus.BAD_REQUEST, {"error": str(error)}
        except (BotoCoreError, ClientError) as error:
            status, value = HTTPStatus.BAD_GATEWAY, {"error": f"AWS refused a call: {error}"}
        self._send(status, _json_file(value, level=1))

    def _send(self, status: HTTPStatus, file: _File) -> None:
        packed = "gzip" in self.headers.get("Accept-Encoding", "")
        body = file.packed if packed else file.body
        self.send_response(status)
        self.send_header("Content-Type", file.kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Vary", "Accept-Encoding")
        if packed:
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_GET  # noqa: N815 - the library's name

    def end_headers(self) -> None:
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Cache-Control", "no-cache")
        self.send_header("Content-Security-Policy", self.server.policy)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the library's name
        """Requests are not news."""


def _load(built: Path) -> dict[str, _File]:
    """Every file of the build by its address, so that nothing else can be asked for."""
    files = {f"/{name}": _file(TYPES[Path(name).suffix], body) for name, body in built_files(built).items()}
    files["/"] = files["/index.html"]
    return files


def _json_file(value: Mapping[str, Any], level: int = 6) -> _File:
    try:
        text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        text = json.dumps(_finite(value), allow_nan=False, separators=(",", ":"))
    return _file(TYPES[".json"], text.encode(), level)


def _finite(value: Any) -> Any:
    """The same, with null for each number that JSON does not have."""
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _file(kind: str, body: bytes, level: int = 6) -> _File:
    return _File(kind, body, gzip.compress(body, level, mtime=0))
