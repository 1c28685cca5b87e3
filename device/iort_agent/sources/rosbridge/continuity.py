"""Repeated and missing messages of one topic, before and after an interruption."""

from __future__ import annotations

from collections import deque

# A latched message comes with the subscription, or not at all.
_AGAIN_S = 10.0
# A topic has few latching publishers; each holds one message.
_RECENT = 16
_MAX_PUBLISHERS = 8
# A number so far ahead comes from another publisher, not from the same one after a loss.
_MAX_GAP = 100_000


class Repeats:
    """Recognizes the latched message that a server repeats with every subscription.

    It equals one of the last messages, word for word. A message without a stamp may be equal and new, like a
    switch that says "on" every second; so on a topic that repeats itself at other times, it counts as new.
    """

    def __init__(self) -> None:
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._again: set[int] = set()
        self._until = 0.0
        self._repeats_itself = False

    def subscribed(self, now: float) -> None:
        """A subscription begins, at that time of the monotonic clock."""
        self._again = set(self._recent)
        self._until = now + _AGAIN_S

    def came_before(self, data: bytes, now: float, *, stamped: bool) -> bool:
        """Whether the server had sent the message before the subscription began."""
        digest = hash(data)
        if self._again and now >= self._until:
            self._again.clear()
        if digest in self._again:
            self._again.discard(digest)
            if stamped or not self._repeats_itself:
                return True
        elif digest in self._recent:
            self._repeats_itself = True
        self._recent.append(digest)
        return False


class Numbers:
    """Counts missing messages by ``header.seq``, which each ROS 1 publisher counts up.

    The server does not name a message's publisher, so the publishers of a topic are told apart by their
    numbers. A gap is no longer counted when another publisher turns out to continue from its beginning.
    """

    def __init__(self) -> None:
        self.missed = 0
        # The last number of each publisher, the most recent at the end.
        self._last: list[int] = []
        # The number before a gap -> how many are missing.
        self._gaps: dict[int, int] = {}

    def take(self, seq: int) -> None:
        """Take a message's number."""
        last = self._last
        if seq in last:
            return
        if seq - 1 in last:
            last.remove(seq - 1)
        elif seq - 1 in self._gaps:
            self.missed -= self._gaps.pop(seq - 1)
        else:
            before = max((one for one in last if seq - _MAX_GAP < one < seq), default=None)
            if before is not None:
                last.remove(before)
                if len(self._gaps) >= _MAX_PUBLISHERS:
                    del self._gaps[next(iter(self._gaps))]
                self._gaps[before] = seq - before - 1
                self.missed += seq - before - 1
        last.append(seq)
        del last[:-_MAX_PUBLISHERS]
