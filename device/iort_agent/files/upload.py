"""Uploads one file: asks the cloud over MQTT for addresses, sends over HTTPS, and resumes after a break.

It keeps no state: the file's hash determines its key, and the bucket knows which parts it has.
"""

from __future__ import annotations

import logging
import random
import threading
import uuid
from pathlib import Path
from typing import Callable

from iort_agent.errors import UploadError
from iort_agent.files.file import LocalFile, changed, look_at
from iort_agent.files.http import ByteRate, Outcome, Sender, trusting
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.limits import ContractError
from iort_contract.messages.requests.files import (
    MAX_ADDRESSES,
    FileAnswer,
    FileRequest,
    decode_file_answer,
    encode_file_request,
    part_range,
)
from iort_contract.topics import FILE, PING, PONG

_log = logging.getLogger(__name__)

_ANSWER_S = 15.0
_LOOK_S = 0.25
# Tries in a row without progress, before other files have their turn.
_TRIES = 6
_MIN_RETRY_S, _MAX_RETRY_S = 1.0, 60.0
_AGAIN_S = 300.0

Progress = Callable[[int], None]


class _Requests:
    """Requests to the cloud, one at a time in each thread."""

    def __init__(self, link: Link) -> None:
        self._link, self._clock = link, link.clock
        self._topic, self._answers = link.topic(PING, FILE), link.topic(PONG, FILE)
        self._lock = threading.Lock()
        self._waiting: dict[str, threading.Event] = {}
        self._answered: dict[str, FileAnswer] = {}
        link.uplink.subscribe(self._answers, self._on_answer)

    def ready(self) -> bool:
        """Whether a request can reach the cloud, and its answer the robot."""
        return self._link.uplink.connected() and self._link.uplink.subscribed(self._answers)

    def ask(self, request: FileRequest, stop: threading.Event) -> FileAnswer | None:
        """The answer to a request; None if it does not come in time. Each request has an id of its own.

        Raises `UploadError` for a request that the contract does not allow.
        """
        try:
            payload = encode_file_request(request)
        except ContractError as error:
            raise UploadError(str(error), again_s=None) from error
        heard = threading.Event()
        with self._lock:
            self._waiting[request.id] = heard
        try:
            self._link.publish(self._topic, payload, qos=1)
            until = self._clock.monotonic() + _ANSWER_S
            while not stop.is_set() and self._clock.monotonic() < until:
                if self._clock.wait(heard, _LOOK_S):
                    break
        finally:
            with self._lock:
                del self._waiting[request.id]
                answer = self._answered.pop(request.id, None)
        return answer

    def _on_answer(self, message: MqttMessage) -> None:
        try:
            answer = decode_file_answer(message.payload)
        except ContractError as error:
            _log.warning("an answer about a file cannot be read: %s", error)
            return
        with self._lock:
            heard = self._waiting.get(answer.id)
            if heard is not None:
                self._answered[answer.id] = answer
                heard.set()


class Uploader:
    """Uploads files, one at a time."""

    def __init__(self, link: Link, sender: Sender, *, chance: random.Random | None = None) -> None:
        self._requests, self._sender, self._clock = _Requests(link), sender, link.clock
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self.ready = self._requests.ready

    @property
    def sent_bytes(self) -> int:
        """The bytes of files sent so far, also in vain."""
        return self._sender.sent_bytes

    def upload(
        self, local: LocalFile, stop: threading.Event, progress: Progress = lambda _bytes: None
    ) -> str:
        """Upload a file. Returns its key once the bucket has the whole file.

        ``progress`` is called with the bytes that the bucket has. Raises `UploadError` if the cloud refuses
        the file, if it changes, after several tries without progress, and when ``stop`` is set.
        """
        transfer = _Transfer(local)
        tries, why = 0, ""
        while not stop.is_set():
            if not self.ready():
                # A lost connection is not a failed try.
                self._clock.wait(stop, _LOOK_S)
                continue
            before = len(transfer.there)
            answer = self._requests.ask(transfer.request(), stop)
            if answer is None:
                why = "no answer from the cloud"
            elif answer.refused is not None:
                raise UploadError(f"{local.path}: refused: {answer.refused}", again_s=answer.again_s)
            elif answer.stored:
                progress(local.look.size)
                return str(answer.key)
            else:
                why = self._send(transfer, answer, stop, progress)
            if len(transfer.there) > before:
                tries = 0
                continue
            tries += 1
            if tries >= _TRIES:
                raise UploadError(f"{local.path}: {why or 'the cloud does not have it'}", again_s=_AGAIN_S)
            ceiling = min(_MAX_RETRY_S, _MIN_RETRY_S * 2**tries)
            self._clock.wait(stop, _MIN_RETRY_S + self._chance.random() * (ceiling - _MIN_RETRY_S))
        raise UploadError(f"{local.path}: stopped", again_s=0)

    def _send(
        self, transfer: _Transfer, answer: FileAnswer, stop: threading.Event, progress: Progress
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
