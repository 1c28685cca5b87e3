"""The agent's own warnings and errors as samples of the stream `log`: few, short, and without secrets."""

from __future__ import annotations

import logging
import re
import threading
from collections import deque

from iort_contract.limits import Value

_OWN = ("iort_agent.", "iort-agent")
# So many lines at once, and then one in this time, for warnings and for errors each: a flood of warnings must
# not displace the error behind it.
_AT_ONCE, _EVERY_S = 20, 3.0
_MAX_CHARACTERS = 1000
# A user and password in an address, and a signature in the query of one.
_SECRETS = ((re.compile(r"//[^/\s]+@"), "//...@"), (re.compile(r"(\w://[^\s?]+\?)\S+"), r"\1..."))


def neutral(text: str) -> str:
    """The text on one line, with escapes for line ends and control characters. Names and answers from
    elsewhere may contain them."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class LogLines:
    """The lines that wait to be sent. `add` only keeps a line, so it is safe wherever something is logged."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._budgets = {False: _Budget(), True: _Budget()}
        self._waiting: deque[tuple[int, dict[str, Value]]] = deque()
        self._left_out = 0

    def add(self, record: logging.LogRecord) -> None:
        """Keep a line of the agent's own, if there were not too many before it."""
        if not record.name.startswith(_OWN):
            return
        with self._lock:
            if not self._budgets[record.levelno >= logging.ERROR].spend(record.created):
                self._left_out += 1
                return
            line: dict[str, Value] = {
                "level": record.levelname.lower(),
                "logger": record.name,
                "text": _text(record),
                "left_out": self._left_out,
            }
            self._left_out = 0
            self._waiting.append((round(record.created * 1e6), line))

    def take(self) -> list[tuple[int, dict[str, Value]]]:
        """The samples since the last call, each with its time in microseconds."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            return taken


class _Budget:
    """`_AT_ONCE` lines, and one more every `_EVERY_S`."""

    def __init__(self) -> None:
        self._left, self._at_s = float(_AT_ONCE), 0.0

    def spend(self, now_s: float) -> bool:
        # The wall clock may jump.
        passed_s = max(0.0, now_s - self._at_s)
        self._left = min(float(_AT_ONCE), self._left + passed_s / _EVERY_S)
        self._at_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True


def _text(record: logging.LogRecord) -> str:
    text = record.getMessage()
    error = record.exc_info[1] if record.exc_info else None
    if error is not None:
        # The traceback stays in the robot's own log.
        text += f": {type(error).__name__}: {error}"
    for secret, shown in _SECRETS:
        text = secret.sub(shown, text)
    text = neutral(text)
    return text if len(text) <= _MAX_CHARACTERS else text[: _MAX_CHARACTERS - 3] + "..."
