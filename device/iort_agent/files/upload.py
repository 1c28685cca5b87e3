"""Uploads one file: asks over MQTT where to, sends it by HTTPS, goes on where a break was.

Nothing has to be remembered: the file says its own key, and the bucket which parts it has.
"""

from __future__ import annotations

import logging
import random
import threading
import uuid
from pathlib import Path
from typing import Callable

from iort_agent.clock import Clock
from iort_agent.errors import UploadError
from iort_agent.files.file import Local, changed, look_at
from iort_agent.files.http import Outcome, Pace, Sender, trusting
from iort_agent.mqtt.uplink import Message, Uplink
from iort_agent.rate_limiter import Allowance
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
from iort_contract.topics import FILE, PING, PONG, build_topic

_log = logging.getLogger(__name__)

_ANSWER_S = 15.0
_LOOK_S = 0.25
# Tries in a row of which none brought the file any further.
_TRIES = 6
_MIN_RETRY_S, _MAX_RETRY_S = 1.0, 60.0
# After those, the file waits while others have their turn.
_AGAIN_S = 300.0

Progress = Callable[[int], None]


class Asker:
    """Asks the cloud about files, one question at a time in each thread."""

    def __init__(
        self, *, robot: str, namespace: str, uplink: Uplink, clock: Clock, allowance: Allowance
    ) -> None:
        self._uplink, self._clock, self._allowance = uplink, clock, allowance
        self._topic = build_topic(PING, robot, FILE, namespace)
        self._answers = build_topic(PONG, robot, FILE, namespace)
        self._lock = threading.Lock()
        self._waiting: dict[str, threading.Event] = {}
        self._answered: dict[str, FileAnswer] = {}
        uplink.subscribe(self._answers, self._on_answer)

    def ready(self) -> bool:
        """Whether a question would reach the cloud, and its answer us."""
        return self._uplink.connected() and self._uplink.subscribed(self._answers)

    def ask(self, request: FileRequest, stop: threading.Event) -> FileAnswer | None:
        """The answer to a request, whose id must be new; None where there is none in time.

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
            self._allowance.spend(self._topic, payload)
            self._uplink.publish(self._topic, payload, qos=1, done=lambda _error: None)
            until = self._clock.monotonic() + _ANSWER_S
            while not stop.is_set() and self._clock.monotonic() < until:
                if self._clock.wait(heard, _LOOK_S):
                    break
        finally:
            with self._lock:
                del self._waiting[request.id]
                answer = self._answered.pop(request.id, None)
        return answer

    def _on_answer(self, message: Message) -> None:
        try:
            answer = decode_file_answer(message.payload)
        except ContractError as error:
            _log.warning("an answer about a file is not one: %s", error)
            return
        with self._lock:
            heard = self._waiting.get(answer.id)
            if heard is not None:
                self._answered[answer.id] = answer
                heard.set()


class Uploader:
    """Brings a file into the bucket, or says why not."""

    def __init__(
        self, *, asker: Asker, sender: Sender, clock: Clock, chance: random.Random | None = None
    ) -> None:
        self._asker, self._sender, self._clock = asker, sender, clock
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets

    def ready(self) -> bool:
        """Whether there is a connection to ask by."""
        return self._asker.ready()

    @property
    def sent_bytes(self) -> int:
        """Bytes of files sent so far, also in vain."""
        return self._sender.sent_bytes

    def upload(self, local: Local, stop: threading.Event, progress: Progress = lambda _bytes: None) -> str:
        """Upload a file that was read; its key in the bucket, once the bucket has all of it.

        ``progress`` is told how many of its bytes are there, as they get there. Raises `UploadError`
        where it is refused, where it changes, after several failures in a row and when ``stop`` is set.
        """
        transfer = _Transfer(local)
        tries, why = 0, ""
        while not stop.is_set():
            if not self._asker.ready():
                # Without a connection nothing is tried, and nothing fails.
                self._clock.wait(stop, _LOOK_S)
                continue
            before = len(transfer.there)
            answer = self._asker.ask(transfer.request(), stop)
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
        """Send what there are addresses for; why that ended, empty for: all of it is sent."""
        transfer.learn(answer)
        progress(transfer.bytes_there())
        for address in answer.addresses:
            local = transfer.local
            first, size = _range(local, address)
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
    """What is known of a file's way into the bucket."""

    def __init__(self, local: Local) -> None:
        self.local = local
        self.there: set[int] = set()
        self._asked_done = False

    def request(self) -> FileRequest:
        """The next question: where to put what is missing, or that nothing is."""
        parts = self.local.parts
        missing = [n for n in range(1, len(parts) + 1) if n not in self.there][:MAX_ADDRESSES]
        self._asked_done = not missing
        return FileRequest(
            id=uuid.uuid4().hex,
            file=self.local.file,
            parts={n: parts[n - 1] for n in missing},
            parts_sha256=None if missing else self.local.parts_sha256,
        )

    def learn(self, answer: FileAnswer) -> None:
        """Take over what the bucket has; it knows better."""
        if self._asked_done:
            self.there.clear()
        for first, last in answer.have:
            self.there.update(range(max(1, first), min(last, len(self.local.parts)) + 1))

    def bytes_there(self) -> int:
        """How much of the file is in the bucket."""
        return sum(part_range(self.local.file, part)[1] for part in self.there)


def _range(local: Local, address: Address) -> tuple[int, int]:
    try:
        return part_range(local.file, address.part)
    except ContractError as error:
        raise UploadError(f"{local.path}: asked for what it does not have: {error}", again_s=None) from error


def make_uploader(
    *,
    robot: str,
    namespace: str,
    uplink: Uplink,
    clock: Clock,
    allowance: Allowance,
    root_ca: Path | None,
    rate_kb_s: float,
) -> Uploader:
    """An uploader as `iort_agent.config.file` says; no faster than ``rate_kb_s``, 0 for no limit."""
    asker = Asker(robot=robot, namespace=namespace, uplink=uplink, clock=clock, allowance=allowance)
    sender = Sender(trust=trusting(root_ca), pace=Pace(clock, rate_kb_s * 1000))
    return Uploader(asker=asker, sender=sender, clock=clock)
