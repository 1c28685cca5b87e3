"""How much is recorded a second, and whether the record lane can send it."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

# Batches close together at the second's edge, so the mean of fewer seconds would go up and down.
_WINDOW_S = 10.0
_EVERY_S = 1.0
# A smaller backlog, in seconds of production or in batches, is normal at a second's edge.
_BACKLOG_S, _FEW = 2.0, 10


class Rate(NamedTuple):
    """Batches and payload bytes, a second or in all."""

    batches: float
    payload_bytes: float


class _Mark(NamedTuple):
    at: float
    # In all: put into the spool, and acknowledged.
    made: Rate
    sent: Rate
    # The smallest backlog since the mark before.
    least: float


class Production:
    """The rates of the last ten seconds. `note` is called several times a second."""

    def __init__(self) -> None:
        self._marks: deque[_Mark] = deque()
        self._least = float("inf")
        self._connected_since: float | None = None
        self.made = self.sent = Rate(0.0, 0.0)
        # Whether the backlog grows although there is a connection.
        self.behind = False

    def note(self, now: float, *, made: Rate, sent: Rate, backlog: float, connected: bool) -> None:
        """Note what was made and sent in all, and how many batches wait now."""
        if not connected:
            self._connected_since = None
        elif self._connected_since is None:
            self._connected_since = now
        self._least = min(self._least, backlog)
        marks = self._marks
        if marks and now - marks[-1].at < _EVERY_S:
            return
        marks.append(_Mark(now, made, sent, self._least))
        self._least = backlog
        if len(marks) == 1:
            return
        while len(marks) > 2 and now - marks[1].at >= _WINDOW_S:
            marks.popleft()
        self.made, self.sent = _per_s(marks, made, marks[0].made), _per_s(marks, sent, marks[0].sent)
        self._judge(now, backlog)

    def _judge(self, now: float, backlog: float) -> None:
        marks, since = list(self._marks), self._connected_since
        if since is None or now - since < _WINDOW_S or backlog <= max(_FEW, self.made.batches * _BACKLOG_S):
            self.behind = False
            return
        # Compare the smallest backlog of each half: batches that have just closed together are no growth.
        half = len(marks) // 2
        before, after = min(m.least for m in marks[:half]), min(m.least for m in marks[half:])
        if after != before:
            self.behind = after > before


def _per_s(marks: deque[_Mark], now: Rate, then: Rate) -> Rate:
    seconds = marks[-1].at - marks[0].at
    return Rate(
        max(0.0, now.batches - then.batches) / seconds,
        max(0.0, now.payload_bytes - then.payload_bytes) / seconds,
    )
