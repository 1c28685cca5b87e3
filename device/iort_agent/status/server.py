"""The status socket: a Unix domain socket that answers its owner with the agent's status as JSON."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import socket
import socketserver
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping

from iort_agent.common.state import Status, read
from iort_agent.common.threads import Supervised
from iort_agent.errors import AgentError, BusyError, NotRunningError

_log = logging.getLogger(__name__)

SOCKET = "agent.sock"
_TIMEOUT_S = 5.0
_NEVER_S = 86_400.0
# The longest path of a socket: sockaddr_un has 108 bytes, with the terminating zero.
_MAX_PATH_BYTES = 107


class StatusServer:
    """Answers every connection with the status. Only its owner may open the socket."""

    def __init__(self, path: Path, status: Callable[[], Mapping[str, Any]]) -> None:
        self._path = path
        self._status = status
        self._server: _Server | None = None
        self._thread: Supervised | None = None

    def start(self) -> None:
        """Listen. Raises `AgentError` if an agent already runs there. If the socket cannot be made, the
        agent runs without it."""
        try:
            if self._path.is_socket():
                self._remove_left_over()
            with _address(self._path) as address:
                self._server = _Server(address, self._status)
        except OSError as error:
            _log.warning("no status socket: %s: %s; set status_socket", self._path, error.strerror or error)
            return
        serve = functools.partial(self._server.serve_forever, poll_interval=_NEVER_S)
        self._thread = Supervised("status", serve)
        self._thread.start()

    def stop(self) -> None:
        """Remove the socket."""
        server, self._server = self._server, None
        if server is not None:
            self._path.unlink(missing_ok=True)
            # The server waits for connections only; this ends its wait.
            with contextlib.suppress(OSError):
                server.socket.shutdown(socket.SHUT_RDWR)
            server.shutdown()
            server.server_close()
        if self._thread is not None:
            self._thread.join()

    def _remove_left_over(self) -> None:
        try:
            process = process_at(self._path)
        except NotRunningError:
            # A killed agent left it behind.
            self._path.unlink(missing_ok=True)
            return
        raise AgentError(
            f"an agent is already running with this configuration (process {process}); "
            "two would take the connection from each other again and again"
        )


class _Server(socketserver.UnixStreamServer):
    def __init__(self, address: str, status: Callable[[], Mapping[str, Any]]) -> None:
        self._status = status
        super().__init__(address, socketserver.BaseRequestHandler)

    def server_bind(self) -> None:
        # On Linux the socket file is created with these permissions.
        os.fchmod(self.fileno(), 0o600)
        super().server_bind()

    def finish_request(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - the library's signature
        request.settimeout(_TIMEOUT_S)
        # The client may have disconnected.
        with contextlib.suppress(OSError):
            request.sendall(json.dumps(self._status()).encode())

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002 - the library's signature
        _log.exception("the status could not be made")


@contextlib.contextmanager
def _address(path: Path) -> Iterator[str]:
    """A path of the socket that is short enough for the kernel, even if the folder's path is long."""
    if len(os.fsencode(path)) <= _MAX_PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def ask(path: Path) -> Status:
    """The status of the running agent. Raises `NotRunningError` if none runs, `BusyError` if it does not
    answer in time, and `AgentError` if the answer cannot be read."""
    try:
        return read(Status, fetch(path))
    except (KeyError, TypeError) as error:
        raise AgentError(f"the agent at {path} is of another version: restart it ({error})") from error


def process_at(path: Path) -> int | None:
    """The process of the running agent, of any version. Raises as `ask`."""
    return fetch(path).get("pid")


def fetch(path: Path) -> dict[str, Any]:
    """The status of the running agent as its JSON document. Raises as `ask`."""
    chunks = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_TIMEOUT_S)
        try:
            with _address(path) as address:
                connection.connect(address)
            while chunk := connection.recv(65536):
                chunks.append(chunk)
        except (socket.timeout, BlockingIOError) as error:
            raise BusyError(
                f"the agent at {path} runs, and has not answered within {_TIMEOUT_S:g} s: try again"
            ) from error
        except OSError as error:
            raise NotRunningError(f"no agent is running: {path}: {error.strerror or error}") from error
    try:
        status = json.loads(b"".join(chunks))
    except ValueError as error:
        raise AgentError(f"the agent at {path} gave no status") from error
    if not isinstance(status, dict):
        raise AgentError(f"the agent at {path} gave no status")
    return status
