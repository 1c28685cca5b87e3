"""When to reconnect, and when to log why: at most one attempt a second, with full jitter.

The agent retries within 1 to 30 s if the network may recover by itself, and within 1 to 5 minutes if a person
must act, because AWS counts and throttles the attempts of a refused robot. Each cause is logged once, and
again only after another cause or a connection.
"""

from __future__ import annotations

import random
from typing import NamedTuple

SHORTEST_S, LONGEST_S = 1.0, 30.0
SLOW_SHORTEST_S, SLOW_LONGEST_S = 60.0, 300.0
# A connection that held for longer than this resets the backoff.
SETTLED_S = 10.0
# A broker that disconnects without an answer may be restarting. After so many in a row it is a refusal.
HANGUPS = 3


class Cause(NamedTuple):
    """Why the connection failed. ``kind`` identifies the cause; ``slow``: a person must act."""

    kind: str
    text: str
    slow: bool = False


class Hangups(NamedTuple):
    """Disconnects without an answer: whether they came again and again, and whether they are a refusal."""

    often: bool
    refused: bool


class Backoff:
    """The wait before the next attempt: random between a floor and a ceiling that doubles."""

    def __init__(self, chance: random.Random | None = None) -> None:
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self._attempts = 0
        self._slow = False

    def reset(self) -> None:
        """Start with short waits again."""
        self._attempts = 0

    def next_s(self, *, slow: bool = False) -> float:
        """Seconds to wait. The first wait has jitter, too; otherwise a fleet would reconnect all at once."""
        if slow != self._slow:
            self._slow, self._attempts = slow, 0
        self._attempts = min(self._attempts + 1, 16)
        shortest, longest = (SLOW_SHORTEST_S, SLOW_LONGEST_S) if slow else (SHORTEST_S, LONGEST_S)
        ceiling = min(longest, shortest * 2.0**self._attempts)
        return shortest + self._chance.random() * (ceiling - shortest)


class Causes:
    """Remembers the last logged cause, and counts disconnects without an answer."""

    def __init__(self) -> None:
        self._logged: str | None = None
        self._hangups = self._in_tls = 0

    def connected(self) -> None:
        """Forget everything: the next cause is news."""
        self._logged = None
        self._hangups = self._in_tls = 0

    def is_news(self, cause: Cause) -> bool:
        """Whether the cause differs from the last one."""
        news, self._logged = cause.kind != self._logged, cause.kind
        return news

    def hung_up(self, *, before_tls: bool) -> Hangups:
        """Count a disconnect without an answer.

        Only those during TLS, in a row, are a refusal: a proxy without a broker behind it resets connections,
        some of them while TLS begins, which the client reports as a failure of TLS.
        """
        self._hangups += 1
        self._in_tls = 0 if before_tls else self._in_tls + 1
        return Hangups(self._hangups >= HANGUPS, self._in_tls >= HANGUPS)
