"""Log lines for a terminal or for journald, and the last ones that matter, for `iort-agent status`."""

from __future__ import annotations

import logging
import os
import sys
from collections import deque
from dataclasses import dataclass
from typing import Any

# syslog's words for it: 3 error, 4 warning, 6 info, 7 debug.
_SYSLOG = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
_KEPT = 5
LOG_LEVELS = ("debug", "info", "warning", "error")


def neutral(text: str) -> str:
    """The text on one line: line ends, a terminal's escapes and other characters that show as nothing are
    written as escapes. Names and answers from elsewhere may hold any."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


@dataclass(frozen=True)
class Trouble:
    """A warning or an error that was logged."""

    at_s: float
    level: str
    text: str


class Troubles(logging.Handler):
    """Keeps the last few warnings, and the last few errors, which no warning displaces."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._warnings: deque[Trouble] = deque(maxlen=_KEPT)
        self._errors: deque[Trouble] = deque(maxlen=_KEPT)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record's text."""
        lines = self._errors if record.levelno >= logging.ERROR else self._warnings
        text = neutral(record.getMessage())
        lines.append(Trouble(round(record.created, 3), record.levelname.lower(), text))

    def last(self) -> list[Trouble]:
        """The newest last."""
        return sorted([*self._errors, *self._warnings], key=lambda line: line.at_s)


class LineFormatter(logging.Formatter):
    """A line a record, and below it, indented, those of its traceback: no text of elsewhere can begin one."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the library's name
        """The record's line."""
        return neutral(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the library's name
        """The traceback's lines."""
        return "\n".join(f"  {neutral(line)}" for line in super().formatException(ei).split("\n"))


class JournalFormatter(LineFormatter):
    """Lines as journald reads them from a service: the level in front, no time; every line of a
    traceback has the level."""

    def format(self, record: logging.LogRecord) -> str:
        """The record's text with its level."""
        prefix = f"<{next(number for level, number in _SYSLOG if record.levelno >= level)}>"
        return "\n".join(prefix + line for line in super().format(record).split("\n"))


def set_up(level: str) -> Troubles:
    """Log to standard error from now on; what is kept for `iort-agent status`."""
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
    """Log from this level on."""
    logging.getLogger().setLevel(level.upper())


def is_journal() -> bool:
    """Whether standard error goes to journald, which says so by device and inode."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
