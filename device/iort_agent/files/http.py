"""PUT a piece of a file to a signed address, no faster than it may."""

from __future__ import annotations

import contextlib
import enum
import http.client
import re
import ssl
import threading
from pathlib import Path
from typing import Iterator, NamedTuple
from urllib.parse import urlsplit

from iort_agent.clock import Clock
from iort_agent.errors import UploadError
from iort_agent.files.file import Local
from iort_contract.messages.files import Address

_CHUNK_BYTES = 64 * 1024
_TIMEOUT_S = 30.0
_MAX_ANSWER_BYTES = 64 * 1024


class Outcome(enum.Enum):
    """What became of a PUT."""

    STORED = "stored"
    # The address is worth nothing any more, or never was: another one is.
    STALE = "stale"
    # What was sent is not what was announced.
    CHANGED = "changed"
    # Nobody's fault but the network's or the server's.
    FAILED = "failed"


class Put(NamedTuple):
    """The outcome of a PUT, and what the server or the network said."""

    outcome: Outcome
    text: str = ""


class Pace:
    """So many bytes a second, for all who send; 0 for as many as there are."""

    def __init__(self, clock: Clock, bytes_per_s: float) -> None:
        self._clock, self._bytes_per_s = clock, bytes_per_s
        self._free_at = clock.monotonic()

    def spend(self, size: int, stop: threading.Event) -> None:
        """Wait until so many bytes may go; returns at once when ``stop`` is set."""
        if not self._bytes_per_s:
            return
        now = self._clock.monotonic()
        wait_s = self._free_at - now
        self._free_at = max(now, self._free_at) + size / self._bytes_per_s
        if wait_s > 0:
            self._clock.wait(stop, wait_s)


class Sender:
    """Sends over HTTPS, a connection a PUT, as S3 closes them when it likes."""

    def __init__(self, *, trust: ssl.SSLContext, pace: Pace) -> None:
        self._trust, self._pace = trust, pace
        self.sent_bytes = 0

    def put(self, address: Address, local: Local, first: int, size: int, stop: threading.Event) -> Put:
        """Send ``size`` bytes of the file from ``first`` on. Raises `UploadError` where ``stop`` is set,
        the file cannot be read, or the address is not one to send anything to."""
        try:
            url = urlsplit(address.url)
            host, port = url.hostname, url.port
        except ValueError as error:
            raise _no_address(error) from error
        if url.scheme != "https" or not host:
            raise UploadError(f"the cloud gave an address that is not https: {url.scheme}", again_s=None)
        if stop.is_set():
            raise UploadError(f"{local.path}: stopped", again_s=0)
        connection = http.client.HTTPSConnection(host, port, timeout=_TIMEOUT_S, context=self._trust)
        with contextlib.closing(connection):
            try:
                connection.connect()
                self._request(connection, url.path, url.query, address, _Piece(local, first, size, stop))
            except (OSError, http.client.HTTPException) as error:
                # A server may refuse before it has read everything; what it says is worth more.
                said = _answer(connection)
                return said or Put(Outcome.FAILED, f"{type(error).__name__}: {error}")
            except ValueError as error:
                # A host that no name can be, a header that no header can be.
                raise _no_address(error) from error
            return _answer(connection) or Put(Outcome.FAILED, "the connection closed without an answer")

    def _request(
        self, connection: http.client.HTTPSConnection, path: str, query: str, address: Address, piece: _Piece
    ) -> None:
        connection.putrequest("PUT", f"{path}?{query}", skip_accept_encoding=True)
        for name, value in address.headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        for chunk in piece:
            self._pace.spend(len(chunk), piece.stop)
            connection.send(chunk)
            self.sent_bytes += len(chunk)


class _Piece:
    """A piece of a file, chunk by chunk."""

    def __init__(self, local: Local, first: int, size: int, stop: threading.Event) -> None:
        self._local, self._first, self._size, self.stop = local, first, size, stop

    def __iter__(self) -> Iterator[bytes]:
        left = self._size
        try:
            file = self._local.open()
        except OSError as error:
            raise UploadError(f"{self._local.path}: {error.strerror or error}", again_s=None) from error
        with file:
            file.seek(self._first)
            while left:
                if self.stop.is_set():
                    raise UploadError(f"{self._local.path}: stopped", again_s=0)
                chunk = file.read(min(_CHUNK_BYTES, left))
                if not chunk:
                    raise UploadError(f"{self._local.path}: became shorter", again_s=10.0)
                left -= len(chunk)
                yield chunk


def _no_address(error: ValueError) -> UploadError:
    return UploadError(f"the cloud gave an address that is none: {error}", again_s=None)


def _answer(connection: http.client.HTTPSConnection) -> Put | None:
    """What the server says, if it still does."""
    try:
        response = connection.getresponse()
        body = response.read(_MAX_ANSWER_BYTES).decode(errors="replace")
    except (OSError, http.client.HTTPException):
        return None
    if response.status == http.client.OK:
        return Put(Outcome.STORED)
    # S3's error document: <Error><Code>...</Code><Message>...</Message>
    found = re.search(r"<Code>([^<]{1,100})</Code>", body)
    code = found[1] if found else response.reason
    text = f"the server says {response.status} {code}"
    if response.status == http.client.BAD_REQUEST and code in ("BadDigest", "XAmzContentChecksumMismatch"):
        return Put(Outcome.CHANGED, text)
    # Forbidden: expired, or signed with credentials that have ended. Not found: the upload was
    # abandoned. Precondition failed: the file is there already. To ask again tells which.
    if response.status in (
        http.client.FORBIDDEN,
        http.client.NOT_FOUND,
        http.client.PRECONDITION_FAILED,
        http.client.BAD_REQUEST,
    ):
        return Put(Outcome.STALE, text)
    return Put(Outcome.FAILED, text)


def trusting(root_ca: Path | None) -> ssl.SSLContext:
    """The system's authorities, and those of the configuration."""
    context = ssl.create_default_context()
    if root_ca is not None:
        context.load_verify_locations(cafile=str(root_ca))
    return context
