"""What an uplink is subscribed to: asked for anew after every connect, and again where it was refused."""

from __future__ import annotations

import functools
import logging
import threading
from concurrent.futures import Future
from typing import Any, Callable

from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.failures import code_name, explain
from iort_agent.mqtt.uplink import Message, OnMessage, matches

_log = logging.getLogger(__name__)

_AGAIN_S, _AGAIN_SLOWLY_S = 10.0, 60.0

# Asks the broker for a topic filter; the callback gets its answer, or the failure, by the dispatcher.
Subscribe = Callable[[str, Callable[["Future[Any]"], None]], None]


class Subscriptions:
    """Topic filters and who listens to them. ``usable`` says whether asking makes sense now, ``refused``
    hears in words of the first refusal of each."""

    def __init__(
        self,
        dispatcher: Dispatcher,
        *,
        subscribe: Subscribe,
        usable: Callable[[], bool],
        refused: Callable[[str], None],
    ) -> None:
        self._dispatcher = dispatcher
        self._subscribe, self._usable, self._tell_refused = subscribe, usable, refused
        self._handlers: dict[str, OnMessage] = {}
        # What the broker has agreed to on this connection.
        self.confirmed: set[str] = set()
        self._refused: set[str] = set()
        self._losses = 0

    def add(self, topic_filter: str, handler: OnMessage) -> None:
        """Receive what matches the filter, from now or the next connect on."""
        self._handlers[topic_filter] = handler
        if self._usable():
            self._dispatcher.post(self.renew)

    def hand_out(self, message: Message) -> None:
        """Let the dispatcher call whoever listens; from the network's own thread."""
        for topic_filter, handler in list(self._handlers.items()):
            if matches(topic_filter, message.topic):
                self._dispatcher.post(functools.partial(handler, message))

    def lost(self) -> None:
        """The connection is lost, and every subscription with it; from the network's own thread."""
        self._losses += 1
        self.confirmed.clear()

    def renew(self) -> None:
        """Ask for what is not confirmed."""
        for topic_filter in list(self._handlers):
            if self._usable() and topic_filter not in self.confirmed:
                self._subscribe(topic_filter, functools.partial(self._on_answer, topic_filter, self._losses))

    def _on_answer(self, topic_filter: str, losses: int, future: Future[Any]) -> None:
        if losses != self._losses:
            return  # of a connection before: this one is asked anew
        error = future.exception()
        if error is None:
            packet = future.result()
            code = packet.reason_codes[0] if packet.reason_codes else None
            if code is not None and code < 128:
                if self._usable():
                    self.confirmed.add(topic_filter)
                    self._refused.discard(topic_filter)
                return
            why = f"the broker says {code_name(code)}" + (
                f", {packet.reason_string}" if packet.reason_string else ""
            )
        else:
            why = explain(error)
        if not self._usable():
            return  # the next connect subscribes anew
        delay_s = _AGAIN_SLOWLY_S if topic_filter in self._refused else _AGAIN_S
        if topic_filter not in self._refused:
            self._refused.add(topic_filter)
            self._tell_refused(f"cannot subscribe to {topic_filter}: {why}")
            _log.error(
                "cannot subscribe to %s, nothing will arrive there; trying again every minute: %s. "
                "If it is not authorized, the robot's policy is older than this agent",
                topic_filter, why,
            )  # fmt: skip
        timer = threading.Timer(delay_s, self._dispatcher.post, (self.renew,))
        timer.daemon = True
        timer.start()
