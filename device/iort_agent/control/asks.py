"""The bridge from ROS to questions: a service and a topic for each, and a topic for the answers."""

from __future__ import annotations

import functools
import json
import queue
import threading
from collections import Counter
from typing import Any, Mapping, Sequence, Tuple

from iort_agent.common.threads import Supervised
from iort_agent.control.bridge import Bridge
from iort_agent.control.config import AskConfig
from iort_agent.control.questions import Questions
from iort_agent.errors import AskError
from iort_agent.ros1.json_message import decode, encode
from iort_contract.checks import json_object
from iort_contract.limits import ContractError, MessageError
from iort_contract.messages.requests.ask import INVALID

STRING = "std_msgs/String"
# Questions by the topic that wait for their turn.
_MOST_WAITING = 8

# The name of a question, its configuration, and the text that was published; None ends the thread.
_Asked = Tuple[str, AskConfig, str]


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
        self._string = bridge.graph.definition(STRING)
        self._queue: queue.Queue[_Asked | None] = queue.Queue(_MOST_WAITING)
        self._thread = Supervised("asks", self._run)
        self._lock = threading.Lock()
        self._counts: dict[str, Counter[str]] = {name: Counter() for name, _ in asks}
        for name, config in asks:
            bridge.graph.offer(asked_on(name), functools.partial(self._called, name, config))
            bridge.graph.advertise(answered_on(name), STRING)
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
        kind = header.get("type")
        if kind != STRING:
            self._bridge.reject(asked_on(name), "malformed", f"type must be {STRING}, got {kind}")
            return
        try:
            self._queue.put_nowait((name, config, decode(self._string, data)["data"]))
        except MessageError as error:
            self._bridge.reject(asked_on(name), "malformed", str(error))
        except queue.Full:
            self._bridge.reject(asked_on(name), "too_many", f"{_MOST_WAITING} questions wait already")

    def _run(self) -> None:
        while (asked := self._queue.get()) is not None:
            name, config, text = asked
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
