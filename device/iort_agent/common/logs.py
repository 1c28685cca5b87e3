"""The agent's log: lines for a terminal or for journald, and what goes on from there.

The latest warnings and errors are in `iort-agent status`; the agent's own ones are also samples of the stream
`log`: few, short, and without secrets.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

from iort_agent.common.threads import Clock
from iort_contract.limits import Value

_OWN = ("iort_agent.", "iort-agent")
# So many lines at once, and then one in this time, for warnings and for errors each: a flood of warnings must
# not displace the error behind it.
_AT_ONCE, _EVERY_S = 20, 3.0
_MAX_CHARACTERS = 1000
# A user and password in an address, and a signature in the query of one.
_SECRETS = ((re.compile(r"//[^/\s]+@"), "//...@"), (re.compile(r"(\w://[^\s?]+\?)\S+"), r"\1..."))
_SYSLOG_LEVELS = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
_KEPT = 5
PERIOD_S = 60.0


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


@dataclass(frozen=True)
class Trouble:
    """A logged warning or error."""

    at_s: float
    level: str
    text: str


class Troubles(logging.Handler):
    """Keeps the latest warnings, and separately the latest errors, so that no warning displaces an error.

    ``lines`` are those to send.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._warnings: deque[Trouble] = deque(maxlen=_KEPT)
        self._errors: deque[Trouble] = deque(maxlen=_KEPT)
        self.lines = LogLines()

    def emit(self, record: logging.LogRecord) -> None:
        lines = self._errors if record.levelno >= logging.ERROR else self._warnings
        text = neutral(record.getMessage())
        lines.append(Trouble(round(record.created, 3), record.levelname.lower(), text))
        self.lines.add(record)

    def last(self) -> list[Trouble]:
        """The kept lines, the newest last."""
        return sorted([*self._errors, *self._warnings], key=lambda line: line.at_s)


class LineFormatter(logging.Formatter):
    """One line for a record, and its traceback indented below. Foreign text cannot start a line."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the library's name
        return neutral(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the library's name
        return "\n".join(f"  {neutral(line)}" for line in super().formatException(ei).split("\n"))


class JournalFormatter(LineFormatter):
    """Lines for journald: each starts with its syslog level; journald adds the time."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{next(number for level, number in _SYSLOG_LEVELS if record.levelno >= level)}>"
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


# A viewer of video costs it twelve lines: each pair of addresses, and what becomes of it.
_TALKATIVE = ("aioice",)


def set_up(level: str) -> Troubles:
    """Log to standard error from now on. Returns the handler that keeps the latest warnings and errors."""
    lines, troubles = logging.StreamHandler(sys.stderr), Troubles()
    lines.setFormatter(
        JournalFormatter("%(message)s")
        if is_journal()
        else LineFormatter("%(asctime)s %(levelname)-7s %(message)s")
    )
    logging.basicConfig(handlers=[lines, troubles])
    set_level(level)
    return troubles


def set_level(level: str) -> None:
    """Log records of this level and above; of a library that tells every step, warnings alone unless the
    level is debug."""
    logging.getLogger().setLevel(level.upper())
    for name in _TALKATIVE:
        logging.getLogger(name).setLevel(logging.WARNING if level == "info" else logging.NOTSET)


def is_journal() -> bool:
    """Whether standard error goes to journald, which tells services its device and inode."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class ThrottledLog:
    """Counts warnings by reason. The first one of a reason is logged at once, later ones once a minute."""

    def __init__(self, log: logging.Logger, clock: Clock) -> None:
        self._log = log
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._logged: dict[str, tuple[float, int]] = {}

    def warn(self, reason: str, text: str) -> None:
        """Count the reason; log the text unless this reason was logged less than a minute ago."""
        now = self._clock.monotonic()
        with self._lock:
            count = self._counts[reason] = self._counts.get(reason, 0) + 1
            at, before = self._logged.get(reason, (float("-inf"), 0))
            if now - at < PERIOD_S:
                return
            self._logged[reason] = (now, count)
        more = f" (and {count - before - 1} more like it)" if count - before > 1 else ""
        self._log.warning("%s%s", text, more)

    def counts(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)
