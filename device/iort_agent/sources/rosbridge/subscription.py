"""When a topic was heard, and when it must be subscribed to again."""

from __future__ import annotations

from typing import NamedTuple

# A message so soon after a new subscription would have come without it, if the server had not been deaf.
_AT_ONCE_S = 5.0
# A topic is silent only after this many of its own longest intervals.
_INTERVALS = 4.0


class Times(NamedTuple):
    """Timeouts and intervals in seconds.

    A ping is sent after `ping_s` without a frame; after `dead_s` the connection is dead. A topic without a
    message may not have existed at the subscription: it is subscribed to again every `ask_again_s`. After
    `patience_s` without a message, on a topic that was silent in all of this connection or on all topics, the
    server may be deaf, as after a restart of the ROS master; the time doubles up to `max_patience_s`. A robot
    has one agent, so its server may be tried often: `backoff_s` is the first and the longest backoff.
    """

    ping_s: float = 5.0
    dead_s: float = 15.0
    ask_again_s: float = 2.0
    patience_s: float = 10.0
    max_patience_s: float = 320.0
    backoff_s: tuple[float, float] = (0.25, 2.0)
    look_s: float = 1.0


TIMES = Times()


class Topic(NamedTuple):
    """A subscription: ``kind`` is the message's type; without it the topic must exist."""

    name: str
    kind: str | None = None
    throttle_ms: int = 0


class Subscription:
    """When a topic was heard, and when it is subscribed to again."""

    def __init__(self, topic: Topic, times: Times) -> None:
        self.topic = topic
        self._times = times
        self.interruptions = self.resubscribed = 0
        self.dark_s = 0.0
        self.heard = False
        self.due = self.ask_again = 0.0
        # Whether it was heard at all, and in this connection.
        self._ever = self._going = False
        self._patience = self._times.patience_s
        self._last = 0.0
        self._longest_s = 0.0
        # At the last fresh subscription: since when nothing had come, and the time of it.
        self._doubted: tuple[float, float] | None = None

    def connected(self, now: float) -> None:
        """A connection begins."""
        self.heard = self._going = False
        self._doubted = None
        self._last = now
        self._patience = self._times.patience_s
        self.due, self.ask_again = now + self._least_s(), now + self._times.ask_again_s

    def hear(self, now: float) -> None:
        """A new message has come."""
        if self._doubted is not None:
            since, at = self._doubted
            self._doubted = None
            if now - at <= _AT_ONCE_S:
                self.interruptions += 1
                self.dark_s += at - since
        elif self._going:
            self._longest_s = max(self._longest_s, now - self._last)
        self._going = self._ever = True
        self._last = now

    def silent(self, now: float) -> bool:
        """Whether the topic has been silent for longer than is normal for it."""
        return now - self._last >= self._least_s()

    def _least_s(self) -> float:
        return max(self._times.patience_s, _INTERVALS * self._longest_s)

    def resubscribing(self, now: float) -> None:
        """The topic is subscribed to afresh."""
        if self._ever:
            # The earlier messages are known, so a message that comes at once was published all the time.
            self.resubscribed += 1
            self._doubted = (self._last, now)
        self._patience = min(self._times.max_patience_s, self._patience * 2)
        self.due, self.ask_again = now + self._patience, now + self._times.ask_again_s
