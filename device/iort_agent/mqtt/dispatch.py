"""Calls the uplink's handlers in one thread, in order, so that the network's own thread never waits for one.

The subscriptions are requested after every connect, and again after a refusal.
"""

from __future__ import annotations

import functools
import logging
import queue
from concurrent.futures import Future
from typing import Any, Callable

from iort_agent.common.threads import Supervised, later
from iort_agent.mqtt.failures import code_name, explain
from iort_agent.mqtt.uplink import MqttMessage, OnMessage, matches

_log = logging.getLogger(__name__)

Call = Callable[[], None]
_AGAIN_S, _AGAIN_SLOWLY_S = 10.0, 60.0
# Requests a topic filter; the dispatcher calls back with the broker's answer or the failure.
Subscribe = Callable[[str, Callable[["Future[Any]"], None]], None]


class Dispatcher:
    """A queue of calls. `start` runs them in a thread; `run_pending` runs them in the calling thread."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self._thread = Supervised("callbacks", self._run)

    def post(self, call: Call) -> None:
        """Run a call later; returns at once, from any thread."""
        self._calls.put(call)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Run the queued calls, then end the thread."""
        if self._thread.is_alive():
            self._calls.put(None)
            self._thread.join(timeout_s)

    def run_pending(self) -> None:
        """Run the queued calls, and those that they queue."""
        while not self._calls.empty():
            call = self._calls.get()
            if call is not None:
                _guarded(call)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            _guarded(call)


def _guarded(call: Call) -> None:
    try:
        call()
    except Exception:  # noqa: BLE001 - whatever a callback raises
        # The thread must outlive a mistake in one callback; otherwise the agent would receive nothing more.
        _log.exception("a callback failed")


class Subscriptions:
    """Topic filters and their handlers. ``usable`` tells whether a request makes sense now; ``refused`` is
    called with a text after the first refusal of each filter."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        *,
        subscribe: Subscribe,
        usable: Callable[[], bool],
        refused: Callable[[str], None],
    ) -> None:
        self._dispatcher = dispatcher
        self._subscribe, self._usable, self._on_refused = subscribe, usable, refused
        self._handlers: dict[str, OnMessage] = {}
        # The filters that the broker has confirmed on this connection.
        self.confirmed: set[str] = set()
        self._refused: set[str] = set()
        self._losses = 0

    def add(self, topic_filter: str, handler: OnMessage) -> None:
        """Receive what matches the filter: now, or after the next connect."""
        self._handlers[topic_filter] = handler
        if self._usable():
            self._dispatcher.post(self.renew)

    def hand_out(self, message: MqttMessage) -> None:
        """Let the dispatcher call the matching handlers. Called in the network's own thread."""
        for topic_filter, handler in list(self._handlers.items()):
            if matches(topic_filter, message.topic):
                self._dispatcher.post(functools.partial(handler, message))

    def lost(self) -> None:
        """Forget what was confirmed: the connection is lost. Called in the network's own thread."""
        self._losses += 1
        self.confirmed.clear()

    def renew(self) -> None:
        """Request the filters that are not confirmed."""
        for topic_filter in list(self._handlers):
            if self._usable() and topic_filter not in self.confirmed:
                self._subscribe(topic_filter, functools.partial(self._on_answer, topic_filter, self._losses))

    def _on_answer(self, topic_filter: str, losses: int, future: Future[Any]) -> None:
        # After a loss, or while disconnected, the next connect requests it again.
        if losses != self._losses or not self._usable():
            return
        why = _refusal(future)
        if why is None:
            self.confirmed.add(topic_filter)
            self._refused.discard(topic_filter)
            return
        delay_s = _AGAIN_SLOWLY_S
        if topic_filter not in self._refused:
            delay_s = _AGAIN_S
            self._refused.add(topic_filter)
            self._on_refused(f"cannot subscribe to {topic_filter}: {why}")
            _log.error(
                "cannot subscribe to %s, nothing will arrive there; trying again every minute: %s. "
                "If it is not authorized, the robot's policy is older than this agent",
                topic_filter, why,
            )  # fmt: skip
        later(delay_s, lambda: self._dispatcher.post(self.renew))


def _refusal(future: Future[Any]) -> str | None:
    """Why a subscription failed; None if the broker confirmed it."""
    error = future.exception()
    if error is not None:
        return explain(error)
    packet = future.result()
    code = packet.reason_codes[0] if packet.reason_codes else None
    if code is not None and code < 128:
        return None
    reason = f", {packet.reason_string}" if packet.reason_string else ""
    return f"the broker says {code_name(code)}{reason}"
