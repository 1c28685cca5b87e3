"""Questions to functions of the cloud: sends one, and waits for its answer."""

from __future__ import annotations

import hashlib
import http.client
import logging
import tempfile
import threading
import uuid
from pathlib import Path, PurePath
from typing import Any, Callable, Mapping

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import later
from iort_agent.control.bridge import offset_us
from iort_agent.errors import AskError, UplinkError, UploadError
from iort_agent.files.file import read
from iort_agent.files.upload import Uploader
from iort_agent.mqtt.rate_limiter import STEADY
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.requests.ask import (
    ASK_FOLDER,
    INVALID,
    MAX_INLINE_BYTES,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_answer,
    encode_ask,
    to_json,
)
from iort_contract.topics import ANSWER, ASK

_log = logging.getLogger(__name__)

# Why there is no answer, beside the cloud's reasons.
NO_ANSWER, NOT_CONNECTED = "no_answer", "not_connected"
# How long a question waits before it asks again for room in the rate limiter.
_NO_ROOM_S = 0.05


class _Wait:
    """A question that waits: ``ended`` is set with its answer, or with why there will be none."""

    def __init__(self) -> None:
        self.ended = threading.Event()
        self.answer: Answer | None = None
        self.failed: AskError | None = None

    def fail(self, why: str) -> None:
        """End the wait, unless it has ended."""
        if not self.ended.is_set():
            self.failed = AskError(NO_ANSWER, why)
            self.ended.set()

    def published(self, error: UplinkError | None) -> None:
        """Note the outcome of the publish."""
        if error is not None:
            self.fail(f"the question was not sent: {error}")


class Questions:
    """Asks questions; safe to use from several threads. Made before the uplink starts.

    Bodies over `MAX_INLINE_BYTES` are files, which ``uploader`` sends and ``download`` gets.
    """

    def __init__(
        self,
        link: Link,
        uploader: Uploader,
        *,
        download: Callable[[str, int], bytes],
        offset: Callable[[], ClockOffset | None],
    ) -> None:
        self._link, self._clock = link, link.clock
        self._uploader, self._download, self._offset = uploader, download, offset
        self._lock = threading.Lock()
        self._waits: dict[str, _Wait] = {}
        self._halted = False
        self._answers = f"{ANSWER}/{link.namespace}/{link.robot}/+"
        link.uplink.subscribe(self._answers, self._on_answer)

    def ready(self) -> bool:
        """Whether a question can reach the cloud, and its answer the robot."""
        return self._link.uplink.connected() and self._link.uplink.subscribed(self._answers)

    def ask(self, name: str, body: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        """The body of the answer. Raises `AskError`: when the cloud refuses, when no answer comes within
        ``timeout_s``, and at once without a connection."""
        until = self._clock.monotonic() + timeout_s
        if not self.ready():
            raise AskError(NOT_CONNECTED, "the robot is not connected to the cloud")
        request_id, wait = uuid.uuid4().hex, _Wait()
        with self._lock:
            if self._halted:
                raise AskError(NO_ANSWER, "the agent ends")
            self._waits[request_id] = wait
        # Also ends an upload that takes too long.
        timer = later(timeout_s, lambda: wait.fail(f"no answer within {timeout_s:g} s"))
        try:
            payload = self._encoded(request_id, body, until, wait)
            topic = self._link.topic(ASK, name)
            while not self._link.rate_limiter.may_go(STEADY, topic, len(payload)):
                if self._clock.wait(wait.ended, _NO_ROOM_S):
                    break
            else:
                self._link.publish(topic, payload, qos=1, done=wait.published)
                self._clock.wait(wait.ended, None)
        finally:
            timer.cancel()
            with self._lock:
                del self._waits[request_id]
        if wait.answer is None:
            raise wait.failed or AskError(NO_ANSWER, "no answer")
        return self._body(wait.answer.body)

    def halt(self) -> None:
        """Let all questions fail that wait or are to come."""
        with self._lock:
            self._halted = True
            waits = list(self._waits.values())
        for wait in waits:
            wait.fail("the agent ends")

    def _encoded(self, request_id: str, body: Mapping[str, Any], until: float, wait: _Wait) -> bytes:
        """The question's message; raises `AskError`."""
        try:
            text = to_json(body)
            given = body if len(text) <= MAX_INLINE_BYTES else self._uploaded(request_id, text, wait)
            left_ms = max(1, round((until - self._clock.monotonic()) * 1000))
            return encode_ask(
                Ask(request_id, self._clock.now_us(), left_ms, given, offset_us(self._offset()))
            )
        except ContractError as error:
            raise AskError(INVALID, str(error)) from error

    def _uploaded(self, request_id: str, text: bytes, wait: _Wait) -> Content:
        name = PurePath(ASK_FOLDER, f"{request_id}.json")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.parent.mkdir()
            path.write_bytes(text)
            try:
                local = read(Path(folder), name, stop=wait.ended)
                key = self._uploader.upload(local, wait.ended)
            except UploadError as error:
                raise wait.failed or AskError(NO_ANSWER, f"the question was not uploaded: {error}") from error
        return Content(key, local.file.sha256, local.file.size)

    def _body(self, body: Mapping[str, Any] | Content | Refusal) -> Mapping[str, Any]:
        if isinstance(body, Refusal):
            raise AskError(body.reason, body.text)
        if not isinstance(body, Content):
            return body
        try:
            text = self._download(body.place, body.size)
            if hashlib.sha256(text).hexdigest() != body.sha256:
                raise AskError(NO_ANSWER, "the answer's file has another SHA-256 than the cloud said")
            return json_object(text, "the answer")
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise AskError(NO_ANSWER, f"the answer's file cannot be read: {error}") from error

    def _on_answer(self, message: MqttMessage) -> None:
        try:
            answer = decode_answer(message.payload)
        except ContractError as error:
            _log.warning("an answer on %s cannot be read: %s", message.topic, error)
            return
        with self._lock:
            wait = self._waits.get(answer.id)
        if wait is not None and not wait.ended.is_set():
            wait.answer = answer
            wait.ended.set()
