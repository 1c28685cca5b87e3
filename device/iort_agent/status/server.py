"""The status socket: a Unix domain socket that answers its owner with the agent's status as JSON."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping

from iort_agent.common.state import Status, read
from iort_agent.errors import AgentError, NotRunningError

_log = logging.getLogger(__name__)

SOCKET = "agent.sock"
_TIMEOUT_S = 5.0
# The longest path of a socket: sockaddr_un has 108 bytes, with the terminating zero.
_MAX_PATH_BYTES = 107


class StatusServer:
    """Answers every connection with the status. Only its owner may open the socket."""

    def __init__(self, path: Path, status: Callable[[], Mapping[str, Any]]) -> None:
        self._path = path
        self._status = status
        self._socket: socket.socket | None = None

    def start(self) -> None:
        """Listen. Raises `AgentError` if an agent already answers there. If the socket cannot be made, the
        agent runs without it."""
        try:
            self._socket = self._bind()
        except OSError as error:
            _log.warning("no status socket: %s: %s; set status_socket", self._path, error.strerror or error)
            return
        threading.Thread(target=self._serve, args=(self._socket,), name="status", daemon=True).start()

    def stop(self) -> None:
        """Remove the socket."""
        listening, self._socket = self._socket, None
        if listening is not None:
            self._path.unlink(missing_ok=True)
            # Closing alone does not wake a thread that waits in accept.
            with contextlib.suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)
            listening.close()

    def _bind(self) -> socket.socket:
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # On Linux the socket file is created with these permissions.
            os.fchmod(listening.fileno(), 0o600)
            with _address(self._path) as address:
                try:
                    listening.bind(address)
                except OSError:
                    if not self._path.is_socket():
                        raise
                    self._refuse_second()
                    self._path.unlink(missing_ok=True)
                    listening.bind(address)
            listening.listen(4)
        except BaseException:
            listening.close()
            raise
        return listening

    def _refuse_second(self) -> None:
        try:
            process = process_at(self._path)
        except NotRunningError:
            return  # a killed agent left the file behind
        raise AgentError(
            f"an agent is already running with this configuration (process {process}); "
            "two would take the connection from each other again and again"
        )

    def _serve(self, listening: socket.socket) -> None:
        while True:
            try:
                connection, _ = listening.accept()
            except OSError:
                return  # stopped
            with connection:
                try:
                    connection.settimeout(_TIMEOUT_S)
                    connection.sendall(json.dumps(self._status()).encode())
                except OSError:
                    pass  # the client has disconnected
                except Exception:  # noqa: BLE001 - the next client must get an answer again
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
    """The status of the running agent. Raises `NotRunningError` if none answers, and `AgentError` if the
    answer cannot be read."""
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
        except OSError as error:
            raise NotRunningError(f"no agent is running: {path}: {error.strerror or error}") from error
    try:
        status = json.loads(b"".join(chunks))
    except ValueError as error:
        raise AgentError(f"the agent at {path} gave no status") from error
    if not isinstance(status, dict):
        raise AgentError(f"the agent at {path} gave no status")
    return status
