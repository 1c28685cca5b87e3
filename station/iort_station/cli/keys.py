"""The keys of `iort drive` as a stick with a dead man's switch.

A terminal tells no release of a key, only repetitions while it is held, and only of the key that was pressed
last. So a key counts as held until its repetitions fail to come. The car then stops.
"""

from __future__ import annotations

from iort_station.fleet.control.driving import Stick

# The longest usual time from a press to its first repetition, and several times the time between two.
FIRST_US, NEXT_US = 700_000, 200_000
_SPEED = {"w": 1.0, "up": 1.0, "s": -1.0, "down": -1.0}
_STEERING = {"a": 1.0, "left": 1.0, "d": -1.0, "right": -1.0}
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_ESCAPE = "\x1b"


def keys_of(text: str) -> list[str]:
    """The keys in what a terminal sent: letters in lower case, and arrows by their names."""
    found, at = [], 0
    while at < len(text):
        if text[at] == _ESCAPE and text[at + 1 : at + 2] in ("[", "O") and text[at + 2 : at + 3] in _ARROWS:
            found.append(_ARROWS[text[at + 2]])
            at += 3
        else:
            found.append(text[at].lower())
            at += 1
    return found


class Keys:
    """The stick that the keys make. Times are microseconds of a monotonic clock."""

    def __init__(self) -> None:
        self._speed = self._steering = 0.0
        self._until_us = self._steering_until_us = 0
        self._last = ""

    def press(self, key: str, now_us: int) -> bool:
        """Take a key or its repetition; whether it moves the stick."""
        if key not in _SPEED and key not in _STEERING:
            return False
        repeated = key == self._last and self.held(now_us)
        if not self.held(now_us):
            self._speed = self._steering = 0.0
        self._last, self._until_us = key, now_us + (NEXT_US if repeated else FIRST_US)
        if key in _SPEED:
            self._speed = _SPEED[key]
        else:
            self._steering, self._steering_until_us = _STEERING[key], self._until_us
        return True

    def let_go(self) -> None:
        self._until_us = 0

    def held(self, now_us: int) -> bool:
        return now_us < self._until_us

    def stick(self, now_us: int) -> Stick:
        """Where the stick is. The speed stays while the terminal repeats another key, which steers."""
        if not self.held(now_us):
            return Stick()
        return Stick(self._speed, self._steering if now_us < self._steering_until_us else 0.0)
