"""PUTs a part of a file to a signed address, at a limited rate."""

from __future__ import annotations

import contextlib
import enum
import http.client
import re
import ssl
import threading
from pathlib import Path
from typing import Callable, Iterator, NamedTuple
from urllib.parse import urlsplit

from iort_agent.clock import Clock
from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, unreadable
from iort_contract.messages.requests.files import Address

_CHUNK_BYTES = 64 * 1024
_TIMEOUT_S = 30.0
_MAX_ANSWER_BYTES = 64 * 1024


class Outcome(enum.Enum):
    """The outcome of a PUT."""

    STORED = "stored"
    # The address is not valid, or no longer; a new one may be.
    STALE = "stale"
    # The content differs from what was announced.
    CHANGED = "changed"
    # The network or the server failed.
    FAILED = "failed"


class Put(NamedTuple):
    """The outcome of a PUT, and the words of the server or of the network."""

    outcome: Outcome
    text: str = ""


class ByteRate:
    """A limit in bytes a second for all senders; 0 for none."""

    def __init__(self, clock: Clock, bytes_per_s: float) -> None:
        self._clock, self._bytes_per_s = clock, bytes_per_s
        self._free_at = clock.monotonic()

    def spend(self, size: int, stop: threading.Event) -> None:
        """Wait until so many bytes may be sent; returns at once when ``stop`` is set."""
        if not self._bytes_per_s:
            return
        now = self._clock.monotonic()
        wait_s = self._free_at - now
        self._free_at = max(now, self._free_at) + size / self._bytes_per_s
        if wait_s > 0:
            self._clock.wait(stop, wait_s)


class Sender:
    """Sends over HTTPS. Each PUT has its own connection, because S3 closes connections at any time."""

    def __init__(self, *, trust: ssl.SSLContext, rate: ByteRate) -> None:
        self._trust, self._rate = trust, rate
        self.sent_bytes = 0

    def put(self, address: Address, local: LocalFile, first: int, size: int, stop: threading.Event) -> Put:
        """Send ``size`` bytes of the file, from ``first`` on.

        Raises `UploadError` if ``stop`` is set, the file cannot be read, or the address is not usable.
        """
        try:
            url = urlsplit(address.url)
            host, port = url.hostname, url.port
        except ValueError as error:
            raise _no_address(error) from error
        if url.scheme != "https" or not host:
            raise UploadError(
                f"the cloud's address must be https with a host, got {url.scheme}", again_s=None
            )
        if stop.is_set():
            raise UploadError(f"{local.path}: stopped", again_s=0)
        connection = http.client.HTTPSConnection(host, port, timeout=_TIMEOUT_S, context=self._trust)
        with contextlib.closing(connection):
            try:
                connection.connect()
                connection.putrequest("PUT", f"{url.path}?{url.query}", skip_accept_encoding=True)
                for name, value in address.headers.items():
                    connection.putheader(name, value)
                connection.endheaders()
                for chunk in _chunks(local, first, size, stop):
                    self._rate.spend(len(chunk), stop)
                    connection.send(chunk)
                    self.sent_bytes += len(chunk)
            except (OSError, http.client.HTTPException) as error:
                # A server may answer before it has read everything; its answer says more than the error.
                return _answer(connection) or Put(Outcome.FAILED, f"{type(error).__name__}: {error}")
            except ValueError as error:
                # The host name or a header has characters that are not allowed.
                raise _no_address(error) from error
            return _answer(connection) or Put(Outcome.FAILED, "the connection closed without an answer")


def _chunks(local: LocalFile, first: int, size: int, stop: threading.Event) -> Iterator[bytes]:
    try:
        file = local.open()
    except OSError as error:
        raise unreadable(local.path, error, again_s=None) from error
    with file:
        file.seek(first)
        left = size
        while left:
            if stop.is_set():
                raise UploadError(f"{local.path}: stopped", again_s=0)
            chunk = file.read(min(_CHUNK_BYTES, left))
            if not chunk:
                raise UploadError(f"{local.path}: became shorter", again_s=10.0)
            left -= len(chunk)
            yield chunk


def _no_address(error: ValueError) -> UploadError:
    return UploadError(f"the cloud's address cannot be used: {error}", again_s=None)


def _answer(connection: http.client.HTTPSConnection) -> Put | None:
    """The server's answer; None without one."""
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
    # Forbidden: expired, or signed with expired credentials. Not found: the upload was abandoned.
    # Precondition failed: the file is already there. The cloud tells which, when asked again.
    if response.status in (
        http.client.FORBIDDEN,
        http.client.NOT_FOUND,
        http.client.PRECONDITION_FAILED,
        http.client.BAD_REQUEST,
    ):
        return Put(Outcome.STALE, text)
    return Put(Outcome.FAILED, text)


def downloader(root_ca: Path | None) -> Callable[[str, int], bytes]:
    """Gets a file of a known size from an address. Raises `OSError`, `HTTPException` or `ValueError`."""
    trust = trusting(root_ca)

    def download(address: str, size: int) -> bytes:
        url = urlsplit(address)
        if url.scheme != "https" or not url.hostname:
            raise ValueError(f"the cloud's address must be https with a host, got {url.scheme}")
        connection = http.client.HTTPSConnection(url.hostname, url.port, timeout=_TIMEOUT_S, context=trust)
        with contextlib.closing(connection):
            connection.request("GET", f"{url.path}?{url.query}")
            response = connection.getresponse()
            if response.status != http.client.OK:
                raise OSError(f"the server says {response.status} {response.reason}")
            return response.read(size)

    return download


def trusting(root_ca: Path | None) -> ssl.SSLContext:
    """A context that trusts the system's authorities and ``root_ca``."""
    context = ssl.create_default_context()
    if root_ca is not None:
        context.load_verify_locations(cafile=str(root_ca))
    return context
