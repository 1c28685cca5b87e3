"""Questions of ROS nodes to functions of the cloud: by a service and a topic each, and a topic of answers."""

from __future__ import annotations

import functools
import hashlib
import http.client
import json
import queue
import tempfile
import threading
import uuid
from collections import Counter
from pathlib import Path, PurePath
from typing import Any, Callable, Mapping, Sequence, Tuple

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import Supervised, later
from iort_agent.control import Bridge, offset_us
from iort_agent.control.config import AskConfig
from iort_agent.errors import AskError, UploadError
from iort_agent.files.file import read
from iort_agent.files.upload import Uploader
from iort_agent.mqtt.rate_limiter import STEADY
from iort_agent.mqtt.requests import Pending, Requests
from iort_agent.mqtt.uplink import Link
from iort_agent.ros.json_message import decode, encode
from iort_contract.checks import json_object
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.envelope import to_json
from iort_contract.messages.questions import (
    ASK_FOLDER,
    INVALID,
    MAX_INLINE_BYTES,
    Answer,
    Ask,
    Content,
    Refusal,
    decode_answer,
    encode_ask,
)
from iort_contract.topics import ANSWER, ASK

# Why there is no answer, beside the cloud's reasons.
NO_ANSWER, NOT_CONNECTED = "no_answer", "not_connected"
# How long a question waits before it asks again for room in the rate limiter.
_NO_ROOM_S = 0.05
_STRINGS = {1: "std_msgs/String", 2: "std_msgs/msg/String"}
# Questions by the topic that wait for their turn.
_MOST_WAITING = 8
# The name of a question, its configuration, and the text that was published; None ends the thread.
_Asked = Tuple[str, AskConfig, str]


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
        self._requests = Requests(link, f"{ANSWER}/{link.namespace}/{link.robot}/+", decode_answer)
        self.ready = self._requests.ready

    def ask(self, name: str, body: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        """The body of the answer. Raises `AskError`: when the cloud refuses, when no answer comes within
        ``timeout_s``, and at once without a connection."""
        until = self._clock.monotonic() + timeout_s
        if not self.ready():
            raise AskError(NOT_CONNECTED, "the robot is not connected to the cloud")
        request_id = uuid.uuid4().hex
        with self._requests.pending(request_id) as wait:
            # Also ends an upload that takes too long.
            timer = later(timeout_s, lambda: wait.end(f"no answer within {timeout_s:g} s"))
            try:
                payload = self._encoded(request_id, body, until, wait)
                topic = self._link.topic(ASK, name)
                over = wait.ended.is_set()
                while not over and not self._link.rate_limiter.may_go(STEADY, topic, len(payload)):
                    over = self._clock.wait(wait.ended, _NO_ROOM_S)
                if not over:
                    self._link.publish(topic, payload, qos=1, done=wait.published)
                    self._clock.wait(wait.ended, None)
            finally:
                timer.cancel()
        if wait.answer is None:
            raise AskError(NO_ANSWER, wait.why)
        return self._body(wait.answer.body)

    def halt(self) -> None:
        """Let all questions fail that wait or are to come."""
        self._requests.halt("the agent ends")

    def _encoded(
        self, request_id: str, body: Mapping[str, Any], until: float, wait: Pending[Answer]
    ) -> bytes:
        """The question's message; raises `AskError`."""
        try:
            text = to_json(body)
            content = body if len(text) <= MAX_INLINE_BYTES else self._uploaded(request_id, text, wait)
            left_ms = max(1, round((until - self._clock.monotonic()) * 1000))
            return encode_ask(
                Ask(request_id, self._clock.now_us(), left_ms, content, offset_us(self._offset()))
            )
        except ContractError as error:
            raise AskError(INVALID, str(error)) from error

    def _uploaded(self, request_id: str, text: bytes, wait: Pending[Answer]) -> Content:
        name = PurePath(ASK_FOLDER, f"{request_id}.json")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.parent.mkdir()
            path.write_bytes(text)
            try:
                local = read(Path(folder), name, stop=wait.ended)
                key = self._uploader.upload(local, wait.ended)
            except UploadError as error:
                raise AskError(NO_ANSWER, wait.why or f"the question was not uploaded: {error}") from error
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


def asked_on(name: str) -> str:
    """The name of a question's service, and of the topic that takes its bodies."""
    return f"/iort/ask/{name}"


def answered_on(name: str) -> str:
    """The topic of a question's answers."""
    return f"/iort/answer/{name}"


class Asks:
    """Offers each question in the ROS graph.

    The service asks in the thread of its call. Bodies from topics wait for their turn in one thread, so that
    answers come in order.
    """

    def __init__(self, asks: Sequence[tuple[str, AskConfig]], bridge: Bridge, questions: Questions) -> None:
        self._bridge, self._questions = bridge, questions
        self._string = bridge.graph.definition(_STRINGS[bridge.graph.ros])
        self._queue: queue.Queue[_Asked | None] = queue.Queue(_MOST_WAITING)
        self._thread = Supervised("asks", self._run)
        self._lock = threading.Lock()
        self._counts: dict[str, Counter[str]] = {name: Counter() for name, _ in asks}
        for name, config in asks:
            bridge.graph.offer(asked_on(name), functools.partial(self._called, name, config))
            bridge.graph.advertise(answered_on(name), self._string.kind)
            bridge.graph.subscribe(asked_on(name), functools.partial(self._on_ros, name, config))

    def start(self) -> None:
        """Begin to take questions from the topics."""
        self._thread.start()

    def halt(self) -> None:
        """Let every question fail that waits or is to come."""
        self._questions.halt()

    def close(self) -> None:
        """End the thread, after `halt`."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def report(self) -> dict[str, dict[str, int]]:
        """The answers of each question, and its failures by their reasons."""
        with self._lock:
            return {name: dict(counts) for name, counts in self._counts.items()}

    def _called(self, name: str, config: AskConfig) -> tuple[bool, str]:
        """The response of the service: the answer's body in JSON, or why there is none."""
        try:
            return True, json.dumps(self._ask(name, config, config.question()))
        except AskError as error:
            return False, f"{error.reason}: {error}"

    def _ask(self, name: str, config: AskConfig, body: Mapping[str, Any]) -> Mapping[str, Any]:
        outcome = "answered"
        try:
            return self._questions.ask(name, body, config.timeout_s)
        except AskError as error:
            outcome = error.reason
            raise
        finally:
            with self._lock:
                self._counts[name][outcome] += 1

    def _on_ros(self, name: str, config: AskConfig, header: Mapping[str, str], data: bytes) -> None:
        kind, string = header.get("type"), self._string.kind
        if kind != string:
            self._bridge.reject(asked_on(name), "malformed", f"type must be {string}, got {kind}")
            return
        try:
            self._queue.put_nowait((name, config, decode(self._string, data)["data"]))
        except MessageError as error:
            self._bridge.reject(asked_on(name), "malformed", str(error))
        except queue.Full:
            self._bridge.reject(asked_on(name), "too_many", f"{_MOST_WAITING} questions wait already")

    def _run(self) -> None:
        while (question := self._queue.get()) is not None:
            name, config, text = question
            try:
                body = json_object(text, "the question") if text.strip() else config.question()
                answer: Mapping[str, Any] = {"body": self._ask(name, config, body)}
            except AskError as error:
                answer = {"refused": error.reason, "text": str(error)}
            except ContractError as error:
                answer = {"refused": INVALID, "text": str(error)}
            data = encode(self._string, {"data": json.dumps(answer)}, now_us=self._bridge.link.clock.now_us())
            if not self._bridge.graph.publish(answered_on(name), data):
                self._bridge.reject(answered_on(name), "no_ros", "the node is not in the ROS graph")
