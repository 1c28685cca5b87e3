"""Log lines for a terminal or for journald, and the latest warnings and errors for `iort-agent status`."""

from __future__ import annotations

import logging
import os
import sys
from collections import deque
from dataclasses import dataclass
from typing import Any

from iort_agent.common.log_lines import LogLines, neutral

_SYSLOG_LEVELS = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))
_KEPT = 5


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
    """Log records of this level and above."""
    logging.getLogger().setLevel(level.upper())


def is_journal() -> bool:
    """Whether standard error goes to journald, which tells services its device and inode."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
