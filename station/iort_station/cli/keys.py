"""The keys of `iort drive` as a stick with a dead man's switch.

A terminal tells no release of a key, only repetitions while it is held, and only of the key that was pressed
last. So a key counts as held until its repetitions fail to come. The car then stops.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from iort_station.fleet.driving import Stick

# The longest usual time from a press to its first repetition, and several times the time between two.
FIRST_US, NEXT_US = 700_000, 200_000
_SPEED = {"w": 1.0, "up": 1.0, "s": -1.0, "down": -1.0}
_STEERING = {"a": 1.0, "left": 1.0, "d": -1.0, "right": -1.0}
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_ESCAPE = "\x1b"
# A key, which may be a sequence of characters, and the beginning of one.
_KEY = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)([@-~])|(.)", re.DOTALL)
_BEGUN = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)?\Z")
# Keys that come at once: more of them have waited on their way, and may have been let go since.
_AT_ONCE = 5


def keys_of(text: str) -> tuple[list[str], str]:
    """The keys in what a terminal sent: letters in lower case, and arrows by their names; and the rest, which
    is the beginning of a key. A key that is a sequence of characters is none of these characters."""
    begun = _BEGUN.search(text)
    end = begun.start() if begun is not None else len(text)
    return [_key(found) for found in _KEY.finditer(text, 0, end)], text[end:]


def _key(found: re.Match[str]) -> str:
    final, letter = found.groups()
    if letter is not None:
        return str(letter).lower()
    return _ARROWS.get(final, _ESCAPE) if len(found[0]) == len("\x1b[A") else _ESCAPE


def moves(key: str) -> bool:
    """Whether a key moves the stick."""
    return key in _SPEED or key in _STEERING


class Keys:
    """The stick that the keys make. Times are microseconds of a monotonic clock."""

    def __init__(self) -> None:
        self._speed = self._steering = 0.0
        self._until_us = self._steering_until_us = 0
        self._last = ""
        self._deaf_until_us = 0

    def arrived(self, keys: Sequence[str], now_us: int) -> None:
        """Note that these keys came at once. If they have waited, let go, and take none until they fail to
        come: whoever held them may have let go while the network stood still."""
        if sum(map(moves, keys)) > _AT_ONCE:
            self.let_go()
            self._deaf_until_us = now_us + NEXT_US

    def press(self, key: str, now_us: int) -> bool:
        """Take a key or its repetition; whether it moves the stick."""
        if not moves(key):
            return False
        if self.late(now_us):
            self._deaf_until_us = now_us + NEXT_US
            return True
        repeated = key == self._last and self.held(now_us)
        if not self.held(now_us):
            self._speed = self._steering = 0.0
        self._last, self._until_us = key, now_us + (NEXT_US if repeated else FIRST_US)
        if key in _SPEED:
            self._speed = _SPEED[key]
        else:
            self._steering, self._steering_until_us = _STEERING[key], self._until_us
        return True

    def late(self, now_us: int) -> bool:
        """Whether keys are not taken, because they came late."""
        return now_us < self._deaf_until_us

    def let_go(self) -> None:
        self._until_us = 0

    def held(self, now_us: int) -> bool:
        return now_us < self._until_us

    def stick(self, now_us: int) -> Stick:
        """Where the stick is. The speed stays while the terminal repeats another key, which steers."""
        if not self.held(now_us):
            return Stick()
        return Stick(self._speed, self._steering if now_us < self._steering_until_us else 0.0)
