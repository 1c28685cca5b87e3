"""Uploads one file: asks the cloud over MQTT for addresses, sends over HTTPS, and resumes after a break.

It keeps no state: the file's hash determines its key, and the bucket knows which parts it has.
"""

from __future__ import annotations

import contextlib
import enum
import http.client
import random
import re
import ssl
import threading
import uuid
from pathlib import Path
from typing import Callable, Iterator, NamedTuple
from urllib.parse import urlsplit

from iort_agent.common.threads import Clock
from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, changed, look_at, unreadable
from iort_agent.mqtt.requests import Requests
from iort_agent.mqtt.uplink import Link
from iort_contract.limits import ContractError
from iort_contract.messages.files import (
    MAX_ADDRESSES,
    Address,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    part_range,
)
from iort_contract.topics import FILE, PING, PONG

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
            connection, path = _https(address.url, self._trust)
        except ValueError as error:
            raise _no_address(error) from error
        if stop.is_set():
            raise UploadError(f"{local.path}: stopped", again_s=0)
        with contextlib.closing(connection):
            try:
                connection.connect()
                connection.putrequest("PUT", path, skip_accept_encoding=True)
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


def _https(address: str, trust: ssl.SSLContext) -> tuple[http.client.HTTPSConnection, str]:
    """A connection to an address, not open yet, and its path. Raises `ValueError`."""
    url = urlsplit(address)
    if url.scheme != "https" or not url.hostname:
        raise ValueError(f"it must be https with a host, got {url.scheme}")
    connection = http.client.HTTPSConnection(url.hostname, url.port, timeout=_TIMEOUT_S, context=trust)
    return connection, f"{url.path}?{url.query}"


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
        connection, path = _https(address, trust)
        with contextlib.closing(connection):
            connection.request("GET", path)
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


_ANSWER_S = 15.0
_LOOK_S = 0.25
# Tries in a row without progress, before other files have their turn.
_TRIES = 6
_MIN_RETRY_S, _MAX_RETRY_S = 1.0, 60.0
_AGAIN_S = 300.0

Progress = Callable[[int], None]


class GaveWayError(UploadError):
    """The rest of a file waits for others."""


class Uploader:
    """Uploads files, one at a time."""

    def __init__(self, link: Link, sender: Sender, *, chance: random.Random | None = None) -> None:
        self._link, self._sender, self._clock = link, sender, link.clock
        self._requests = Requests(link, link.topic(PONG, FILE), decode_file_answer)
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self.ready = self._requests.ready

    @property
    def sent_bytes(self) -> int:
        """The bytes of files sent so far, also in vain."""
        return self._sender.sent_bytes

    def upload(
        self,
        local: LocalFile,
        stop: threading.Event,
        progress: Progress = lambda _bytes: None,
        gives_way: Callable[[], bool] = lambda: False,
    ) -> str:
        """Upload a file. Returns its key once the bucket has the whole file.

        ``progress`` is called with the bytes that the bucket has. Raises `UploadError` if the cloud refuses
        the file, if it changes, after several tries without progress, and when ``stop`` is set; and
        `GaveWayError` if it ``gives_way`` after a part.
        """
        transfer = _Transfer(local)
        tries, why = 0, ""
        while not stop.is_set():
            if not self.ready():
                # A lost connection is not a failed try.
                self._clock.wait(stop, _LOOK_S)
                continue
            before = len(transfer.there)
            answer = self._ask(transfer.request(), stop)
            if answer is None:
                why = "no answer from the cloud"
            elif answer.refused is not None:
                raise UploadError(f"{local.path}: refused: {answer.refused}", again_s=answer.again_s)
            elif answer.stored:
                progress(local.look.size)
                return str(answer.key)
            else:
                why = self._send(transfer, answer, stop, progress, gives_way)
            if len(transfer.there) > before:
                tries = 0
                continue
            tries += 1
            if tries >= _TRIES:
                raise UploadError(f"{local.path}: {why or 'the cloud does not have it'}", again_s=_AGAIN_S)
            ceiling = min(_MAX_RETRY_S, _MIN_RETRY_S * 2**tries)
            self._clock.wait(stop, _MIN_RETRY_S + self._chance.random() * (ceiling - _MIN_RETRY_S))
        raise UploadError(f"{local.path}: stopped", again_s=0)

    def _ask(self, request: FileRequest, stop: threading.Event) -> FileAnswer | None:
        """The answer to a request; None if it does not come in time. Raises `UploadError` for a request that
        the contract does not allow."""
        try:
            payload = encode_file_request(request)
        except ContractError as error:
            raise UploadError(str(error), again_s=None) from error
        with self._requests.pending(request.id) as wait:
            self._link.publish(self._link.topic(PING, FILE), payload, qos=1)
            until = self._clock.monotonic() + _ANSWER_S
            while not stop.is_set() and self._clock.monotonic() < until:
                if self._clock.wait(wait.ended, _LOOK_S):
                    break
        return wait.answer

    def _send(
        self,
        transfer: _Transfer,
        answer: FileAnswer,
        stop: threading.Event,
        progress: Progress,
        gives_way: Callable[[], bool],
    ) -> str:
        """Send the parts that have an address. Returns why it ended; an empty text if all are sent."""
        local = transfer.local
        transfer.take(answer)
        progress(transfer.bytes_there())
        for address in answer.addresses:
            first, size = transfer.part_range(address.part)
            if look_at(local.root, local.name) != local.look:
                raise changed(local.path)
            put = self._sender.put(address, local, first, size, stop)
            if put.outcome is Outcome.CHANGED:
                raise changed(local.path)
            if put.outcome is not Outcome.STORED:
                return put.text
            transfer.there.add(address.part)
            progress(transfer.bytes_there())
            if len(transfer.there) < local.file.parts and gives_way():
                raise GaveWayError(f"{local.path}: gives way", again_s=0)
        return ""


class _Transfer:
    """The parts of a file that the bucket has."""

    def __init__(self, local: LocalFile) -> None:
        self.local = local
        self.there: set[int] = set()
        self._asked_done = False

    def request(self) -> FileRequest:
        """The next request: addresses for missing parts, or confirmation that none is missing."""
        parts = self.local.parts
        missing = [n for n in range(1, len(parts) + 1) if n not in self.there][:MAX_ADDRESSES]
        self._asked_done = not missing
        return FileRequest(
            id=uuid.uuid4().hex,
            file=self.local.file,
            parts={n: parts[n - 1] for n in missing},
            parts_sha256=None if missing else self.local.parts_sha256,
        )

    def take(self, answer: FileAnswer) -> None:
        """Take over which parts the bucket has."""
        if self._asked_done:
            self.there.clear()
        for first, last in answer.have:
            self.there.update(range(max(1, first), min(last, len(self.local.parts)) + 1))

    def bytes_there(self) -> int:
        return sum(self.part_range(part)[1] for part in self.there)

    def part_range(self, part: int) -> tuple[int, int]:
        """First byte and size of a part."""
        try:
            return part_range(self.local.file, part)
        except ContractError as error:
            raise UploadError(f"{self.local.path}: the cloud's address: {error}", again_s=None) from error


def make_uploader(link: Link, *, root_ca: Path | None, rate_kb_s: float) -> Uploader:
    """An uploader that is no faster than ``rate_kb_s``; 0 is no limit."""
    rate = ByteRate(link.clock, rate_kb_s * 1000)
    return Uploader(link, Sender(trust=trusting(root_ca), rate=rate))
