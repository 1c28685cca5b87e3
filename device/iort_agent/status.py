"""`iort-agent status`: a Unix domain socket that gives whoever may read it the agent's state as JSON."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
import time
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping

from iort_agent.errors import AgentError
from iort_agent.logs import neutral

_log = logging.getLogger(__name__)

SOCKET = "agent.sock"
_TIMEOUT_S = 5.0
# sockaddr_un has room for so many bytes, the terminating zero included.
_MAX_PATH_BYTES = 107


class StatusServer:
    """Answers every connection with one report. The socket is its owner's alone."""

    def __init__(self, path: Path, report: Callable[[], Mapping[str, Any]]) -> None:
        self._path = path
        self._report = report
        self._socket: socket.socket | None = None

    def start(self) -> None:
        """Listen. Raises `AgentError` where an agent is already answering there; where the socket
        cannot be made, the agent goes on without."""
        try:
            self._socket = self._bind()
        except OSError as error:
            _log.warning("no status: %s: %s; set status_socket", self._path, error.strerror or error)
            return
        threading.Thread(target=self._serve, args=(self._socket,), name="status", daemon=True).start()

    def stop(self) -> None:
        """Remove the socket."""
        listening, self._socket = self._socket, None
        if listening is not None:
            self._path.unlink(missing_ok=True)
            # Closing alone would not wake a thread that waits in accept.
            with contextlib.suppress(OSError):
                listening.shutdown(socket.SHUT_RDWR)
            listening.close()

    def _bind(self) -> socket.socket:
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # The socket file takes over these permissions (Linux); there is no moment without them.
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
            running = fetch(self._path)
        except AgentError:
            return  # left behind by an agent that was killed
        raise AgentError(
            f"an agent is already running with this configuration (process {running.get('pid')}); "
            "two would take the connection from each other"
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
                    connection.sendall(json.dumps(self._report()).encode())
                except OSError:
                    pass  # whoever asked has gone
                except Exception:  # noqa: BLE001 - whoever asks next should get an answer again
                    _log.exception("no status this time")


@contextlib.contextmanager
def _address(path: Path) -> Iterator[str]:
    """A name of the socket that is short enough, as long as the name of its file is."""
    if len(os.fsencode(path)) <= _MAX_PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def fetch(path: Path) -> dict[str, Any]:
    """The state of the agent that listens there; raises `AgentError` where none answers."""
    chunks = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_TIMEOUT_S)
        try:
            with _address(path) as address:
                connection.connect(address)
            while chunk := connection.recv(65536):
                chunks.append(chunk)
        except OSError as error:
            raise AgentError(f"no agent is running: {path}: {error.strerror or error}") from error
    try:
        state = json.loads(b"".join(chunks))
    except ValueError as error:
        raise AgentError(f"no state from the agent at {path}") from error
    if not isinstance(state, dict):
        raise AgentError(f"no state from the agent at {path}")
    return state


def render(state: Mapping[str, Any]) -> str:
    """The state for a person."""
    connection, lanes, spool = state["connection"], state["lanes"], state["spool"]
    since = _duration(connection["since_s"])
    link = f"connected for {since}" if connection["connected"] else f"NOT connected for {since}"
    lines = [
        f"robot     {state['robot']}, running for {_duration(state['uptime_s'])}, process {state['pid']}",
        f"uplink    {link} to {connection['endpoint']}, {connection['connects']} connect(s)",
    ]
    if connection["last_error"]:
        lines.append(f"          last error: {connection['last_error']}")
    lines.append(
        f"record    {_on(lanes['record'])}, {spool['batches']} batch(es), {spool['samples']} sample(s), "
        f"{spool['bytes']:,} bytes waiting; {spool['dropped_batches']} batch(es) dropped"
    )
    live = lanes["live"]
    slowed = f", SLOWED to {live['effective_hz']:g} Hz a stream by AWS' limit" if live["slowed"] else ""
    lines.append(
        f"live      {_on(live)}, up to {live['rate_hz']:g} Hz{slowed}, {live['published']} sent, "
        f"{live['refused']} refused"
    )
    for name, stream in state["streams"].items():
        fields = f", only {', '.join(stream['fields'])}" if stream.get("fields") else ""
        silent = f", SILENT for {_duration(stream['silent_s'])}" if stream["silent_s"] >= 5 else ""
        lines.append(
            f"stream    {name}: {stream['per_s']:g}/s, live {stream['live_hz']:g}/s, "
            f"{stream['samples']} samples, {stream['refused']} refused{silent}{fields}"
        )
    for source in state["sources"]:
        counts = {
            name: value
            for name, value in source.items()
            if name != "source" and not (isinstance(value, Mapping) and "messages" in value)
        }
        flat = {name: value for name, value in counts.items() if not isinstance(value, Mapping)}
        lines.append(f"source    {source['source']}{_told(flat, ': ')}")
        for name, value in counts.items():
            if name not in flat and _told(value):
                lines.append(f"          {name}{_told(value, ': ')}")
        lines += [f"topic     {name}: {what}" for name, what in _not_recorded(source)]
    files = state.get("files")
    if files is not None:
        current = f", now {files['current']} ({files['current_bytes']:,} bytes)" if files["current"] else ""
        lines.append(
            f"files     {files['waiting']} waiting, {files['uploaded']} uploaded, "
            f"{files['sent_bytes']:,} bytes sent{current}"
        )
        if files["last_error"]:
            lines.append(f"          last error: {files['last_error']}")
    clock = state["clock"]
    if clock is not None:
        offset, uncertainty = clock["offset_ms"], clock["uncertainty_ms"]
        lines.append(f"clock     the cloud's is {offset:+.1f} ms from ours, to within {uncertainty:.1f} ms")
    over = state.get("over_share")
    if over is not None:
        lines.append(
            f"share     {over['batches']} batch(es) over this robot's share of the cloud, the last at "
            f"{_clock(over['last_ms'] / 1000)}: their summaries are made later"
        )
    lines += [f"ALARM     {alarm}" for alarm in state["alarms"]]
    for trouble in state["troubles"]:
        lines.append(f"{trouble['level']:<9} {_clock(trouble['at_s'])} {trouble['text']}")
    return "\n".join(map(neutral, lines))


def _told(counts: Mapping[str, Any], before: str = "") -> str:
    """Those counts of a source that are not zero or empty; nothing where all are."""
    parts = []
    for name, value in counts.items():
        if isinstance(value, Mapping):
            parts += [f"{name} ({_told(value)})"] if _told(value) else []
        elif value:
            texts = value if isinstance(value, list) else [value]
            parts.append(name if value is True else f"{name} {' '.join(map(str, texts))}")
    return before + ", ".join(parts) if parts else ""


def _not_recorded(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The topics of a source's report of which something is missing, and what."""
    for topic, counts in source.items():
        if not isinstance(counts, dict) or "messages" not in counts:
            continue
        words = []
        for cause, count in counts.items():
            # Of what is counted by field, the fields are named.
            by_name = count.items() if isinstance(count, dict) else [("", count)]
            words += [
                f"{n} {cause.replace('_', ' ')} {name}".rstrip()
                for name, n in by_name
                if type(n) is int and n and cause != "messages"
            ]
        silent = ", SILENT" if counts.get("silent") else ""
        if words or silent:
            yield topic, "; ".join([f"{counts['messages']} messages{silent}", *words])


def _on(lane: Mapping[str, Any]) -> str:
    return "on" if lane["enabled"] else "off"


def _clock(at_s: float) -> str:
    return time.strftime("%H:%M:%SZ", time.gmtime(at_s))


def _duration(seconds: float) -> str:
    whole = int(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
