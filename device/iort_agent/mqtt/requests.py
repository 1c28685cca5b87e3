"""Requests over MQTT and their answers, which are matched by the requests' ids."""

from __future__ import annotations

import logging
import threading
from contextlib import contextmanager
from typing import Callable, Generic, Iterator, TypeVar

from iort_agent.errors import UplinkError
from iort_agent.mqtt.uplink import Link, MqttMessage
from iort_contract.limits import ContractError
from iort_contract.messages.files import FileAnswer
from iort_contract.messages.questions import Answer

_log = logging.getLogger(__name__)


AnswerT = TypeVar("AnswerT", Answer, FileAnswer)


class Pending(Generic[AnswerT]):
    """A request on its way: ``ended`` is set with its ``answer``, or with why there will be none."""

    def __init__(self) -> None:
        self.ended = threading.Event()
        self.answer: AnswerT | None = None
        self.why = ""

    def end(self, why: str) -> None:
        """End it without an answer, unless it has ended."""
        if not self.ended.is_set():
            self.why = why
            self.ended.set()

    def published(self, error: UplinkError | None) -> None:
        """Note the outcome of the publish."""
        if error is not None:
            self.end(f"the question was not sent: {error}")


class Requests(Generic[AnswerT]):
    """The requests of one kind. Made before the uplink starts; safe to use from several threads."""

    def __init__(self, link: Link, answers: str, decode: Callable[[bytes], AnswerT]) -> None:
        self._uplink, self._answers = link.uplink, answers
        self._decode: Callable[[bytes], AnswerT] = decode
        self._lock = threading.Lock()
        self._pending: dict[str, Pending[AnswerT]] = {}
        self._halted = ""
        link.uplink.subscribe(answers, self._on_answer)

    def ready(self) -> bool:
        """Whether a request can reach the cloud, and its answer the robot."""
        return self._uplink.connected() and self._uplink.subscribed(self._answers)

    @contextmanager
    def pending(self, request_id: str) -> Iterator[Pending[AnswerT]]:
        """Take the answer of this id within a `with`. Each request has an id of its own."""
        pending: Pending[AnswerT] = Pending()
        with self._lock:
            self._pending[request_id] = pending
            if self._halted:
                pending.end(self._halted)
        try:
            yield pending
        finally:
            with self._lock:
                del self._pending[request_id]

    def halt(self, why: str) -> None:
        """End every request that waits or is to come."""
        with self._lock:
            self._halted = why
            for pending in self._pending.values():
                pending.end(why)

    def _on_answer(self, message: MqttMessage) -> None:
        try:
            answer = self._decode(message.payload)
        except ContractError as error:
            _log.warning("an answer on %s cannot be read: %s", message.topic, error)
            return
        with self._lock:
            pending = self._pending.get(answer.id)
        if pending is not None and not pending.ended.is_set():
            pending.answer = answer
            pending.ended.set()
