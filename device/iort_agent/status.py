"""The agent's status: a Unix domain socket that gives it to its owner as JSON, and its text for a person."""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import socket
import socketserver
import time
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping

from iort_agent.common.logs import neutral
from iort_agent.common.state import Files, LiveState, Queue, RecordState, Status, read
from iort_agent.common.threads import Supervised
from iort_agent.errors import AgentError, BusyError, NotRunningError
from iort_contract.catalog.streams import OWN_STREAMS

_log = logging.getLogger(__name__)

SOCKET = "agent.sock"
_TIMEOUT_S = 5.0
_NEVER_S = 86_400.0
# The longest path of a socket: sockaddr_un has 108 bytes, with the terminating zero.
_MAX_PATH_BYTES = 107
# A stream that is silent for longer is marked.
_SILENT_S = 5


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


def render(status: Status) -> str:
    """The status as lines."""
    lines = [
        f"robot     {status.robot}, running for {_duration(status.uptime_s)}, process {status.pid}",
        *_link(status),
        *_lanes(status),
    ]
    for source in status.sources:
        lines += _source(source)
    if status.files is not None:
        lines += _files(status.files)
    if status.recorder is not None:
        lines.append(f"recorder  {_told(status.recorder)}")
    if status.video is not None:
        lines.append(f"video     {_told(status.video) or 'nobody looks'}")
    if status.clock is not None:
        offset_ms, uncertainty_ms = status.clock.offset_ms, status.clock.uncertainty_ms
        lines.append(
            f"clock     the cloud's is {offset_ms:+.1f} ms from ours, to within {uncertainty_ms:.1f} ms"
        )
    over = status.over_share
    if over is not None:
        lines.append(
            f"share     {over.batches} batch(es) over this robot's share of the cloud, the last at "
            f"{_clock(over.last_ms / 1000)}: their summaries are made later"
        )
    lines += [f"ALARM     {alarm}" for alarm in status.alarms]
    lines += [f"{trouble.level:<9} {_clock(trouble.at_s)} {trouble.text}" for trouble in status.troubles]
    return "\n".join(map(neutral, lines))


def _link(status: Status) -> Iterator[str]:
    link = status.connection
    since = _duration(link.since_s)
    state = f"connected for {since}" if link.connected else f"NOT connected for {since}"
    yield f"uplink    {state} to {link.endpoint}, {link.connects} connect(s)"
    if link.last_error:
        yield f"          last error: {link.last_error}"


def _lanes(status: Status) -> Iterator[str]:
    record, live, queue = status.lanes.record, status.lanes.live, status.spool
    viewers = "nobody" if not live.viewers else f"{live.viewers} viewer{'' if live.viewers == 1 else 's'}"
    yield f"record    {_on(record)}, {_queue(queue)}"
    slowed = f", SLOWED to {live.effective_hz:g} Hz a stream by AWS' limit" if live.slowed else ""
    yield (
        f"live      {_on(live)}, {live.asked_hz:g} of up to {live.rate_hz:g} Hz for {viewers}{slowed}, "
        f"{live.published} sent, "
        f"{live.refused} refused"
    )
    for name, stream in status.streams.items():
        fields = f", only {', '.join(stream.fields)}" if stream.fields else ""
        # The agent's own streams have their own pace.
        marked = stream.silent_s >= _SILENT_S and name not in OWN_STREAMS
        silent = f", SILENT for {_duration(stream.silent_s)}" if marked else ""
        yield (
            f"stream    {name}: {stream.per_s:g}/s, live {stream.live_hz:g}/s, "
            f"{stream.samples} samples, {stream.refused} refused{silent}{fields}"
        )


def _queue(queue: Queue) -> str:
    return (
        f"{queue.batches} batch(es), {queue.samples} sample(s), {queue.bytes:,} bytes waiting "
        f"{'on the disk' if queue.durable else 'IN MEMORY'}; "
        f"{queue.dropped_batches} batch(es) dropped"
    )


def _source(source: Mapping[str, Any]) -> Iterator[str]:
    """The counts of a source: one line, one more for each group of counts, and one for each topic that lost
    something."""
    counts = {
        name: value
        for name, value in source.items()
        if name != "source" and not (isinstance(value, Mapping) and "messages" in value)
    }
    flat = {name: value for name, value in counts.items() if not isinstance(value, Mapping)}
    yield f"source    {source['source']}{_told(flat, ': ')}"
    for name, value in counts.items():
        if name not in flat and _told(value):
            yield f"          {name}{_told(value, ': ')}"
    for name, missing in _not_recorded(source):
        yield f"topic     {name}: {missing}"


def _files(files: Files) -> Iterator[str]:
    current = f", now {files.current} ({files.current_bytes:,} bytes)" if files.current else ""
    yield (
        f"files     {files.waiting} waiting, {files.uploaded} uploaded, "
        f"{files.sent_bytes:,} bytes sent{current}"
    )
    if files.last_error:
        yield f"          last error: {files.last_error}"


def _told(counts: Mapping[str, Any], before: str = "") -> str:
    """The counts of a source that are neither zero nor empty; an empty text if all are."""
    parts = []
    for name, value in counts.items():
        if isinstance(value, Mapping):
            parts += [f"{name} ({_told(value)})"] if _told(value) else []
        elif value:
            texts = value if isinstance(value, list) else [value]
            parts.append(name if value is True else f"{name} {' '.join(map(str, texts))}")
    return before + ", ".join(parts) if parts else ""


def _not_recorded(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Each topic of a source that lost something, and what it lost."""
    for topic, counts in source.items():
        if not isinstance(counts, dict) or "messages" not in counts:
            continue
        words = []
        for cause, count in counts.items():
            # Some causes are counted by field.
            by_name = count.items() if isinstance(count, dict) else [("", count)]
            words += [
                f"{n} {cause.replace('_', ' ')} {name}".rstrip()
                for name, n in by_name
                if type(n) is int and n and cause != "messages"
            ]
        silent = ", SILENT" if counts.get("silent") else ""
        if words or silent:
            yield topic, "; ".join([f"{counts['messages']} messages{silent}", *words])


def _on(lane: RecordState | LiveState) -> str:
    return "on" if lane.enabled else "off"


def _clock(at_s: float) -> str:
    return time.strftime("%H:%M:%SZ", time.gmtime(at_s))


def _duration(seconds: float) -> str:
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
