"""When to connect again, and what to say about why: no more than one attempt a second, full jitter.

A cause that the network may cure by itself is tried again within 1 to 30 s; one that a person must
cure within 1 to 5 minutes, because AWS counts and throttles what a refused robot does. Each cause is
said once, with what to do about it, and again only after something else happened.
"""

from __future__ import annotations

import random
from typing import NamedTuple

SHORTEST_S, LONGEST_S = 1.0, 30.0
SLOW_SHORTEST_S, SLOW_LONGEST_S = 60.0, 300.0
# So long must a connection hold before the next loss counts as a new one, with a short wait again.
SETTLED_S = 10.0
# A broker that hangs up instead of an answer may be restarting; so often in a row it is a refusal.
HANGUPS = 3


class Cause(NamedTuple):
    """Why there is no connection. ``kind`` tells one cause from the next; ``slow``: a person must act."""

    kind: str
    text: str
    slow: bool = False


class Backoff:
    """The wait before the next attempt: random between a floor and a ceiling that doubles."""

    def __init__(self, chance: random.Random | None = None) -> None:
        self._chance = chance or random.Random()  # noqa: S311 - jitter, not secrets
        self._attempts = 0
        self._slow = False

    def reset(self) -> None:
        """The connection held: begin with short waits again."""
        self._attempts = 0

    def next_s(self, *, slow: bool = False) -> float:
        """Seconds to wait; the first wait is jittered too, or a fleet would return all at once."""
        if slow != self._slow:
            self._slow, self._attempts = slow, 0
        self._attempts = min(self._attempts + 1, 16)
        shortest, longest = (SLOW_SHORTEST_S, SLOW_LONGEST_S) if slow else (SHORTEST_S, LONGEST_S)
        ceiling = min(longest, shortest * 2.0**self._attempts)
        return shortest + self._chance.random() * (ceiling - shortest)


class Causes:
    """Remembers what was said."""

    def __init__(self) -> None:
        self._said: str | None = None
        self._hangups = 0
        self._before_tls = False

    def connected(self) -> None:
        """Whatever comes now is news."""
        self._said = None
        self._hangups = 0

    def is_news(self, cause: Cause) -> bool:
        """Whether the cause was not the last one said."""
        news, self._said = cause.kind != self._said, cause.kind
        return news

    def hung_up(self, *, before_tls: bool) -> bool:
        """Count a connection closed without an answer; whether it is time to call it a refusal.

        A proxy with no broker behind it resets connections. Some of those resets come while TLS begins, and
        the client calls that a failure of TLS; so what counts is how often in a row TLS had begun, or not.
        """
        self._hangups = self._hangups + 1 if before_tls == self._before_tls else 1
        self._before_tls = before_tls
        return self._hangups >= HANGUPS
