"""Log records as people read them: what happened in the first line, and the details after it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_TRACEBACK = "Traceback (most recent call last):"
# Lambda's keys of a record in JSON that are not details. Its own lines have the second spelling.
_LEVELS = ("level", "log_level")
_TOLD = (*_LEVELS, "timestamp", "message", "errorType", "errorMessage", "stackTrace", "location")


def readable(message: str) -> str:
    """A log record whose first line says what happened: an exception, or the logged text.

    A record is a text, or an object in JSON, as AWS writes those of our functions.
    """
    text = message.strip()
    if text.startswith("{"):
        try:
            record = json.loads(text)
        except ValueError:
            return text
        return _of_json(record)
    before, traceback, stack = text.partition(_TRACEBACK)
    if not traceback:
        return text
    # The exception ends a traceback; Lambda writes it before that.
    lines = [line for line in stack.splitlines() if line.strip()]
    exception = lines[-1] if lines and not lines[-1].startswith((" ", "\t", "\u00a0")) else ""
    logged = " ".join(before.split())
    head = logged if exception and exception in logged else _joined(logged, exception)
    return f"{head}\n{text}" if head else text


def _of_json(record: Mapping[str, Any]) -> str:
    level = next((str(record[name]) for name in _LEVELS if name in record), "")
    kind, said = (str(record.get(name) or "") for name in ("errorType", "errorMessage"))
    exception = f"{kind}: {said}" if kind and said else kind or said
    message = str(record.get("message") or "")
    head = _joined(message, "" if said and said in message else exception)
    if not head:
        return json.dumps(record)
    stack = record.get("stackTrace") or ""
    frames = stack if isinstance(stack, str) else "\n".join(str(frame).rstrip() for frame in stack)
    others = {name: value for name, value in record.items() if name not in _TOLD}
    details = [frames, *(f"{name}: {value}" for name, value in others.items())]
    return "\n".join(filter(None, (f"[{level}] {head}" if level else head, *details)))


def _joined(logged: str, exception: str) -> str:
    return ": ".join(filter(None, (logged.rstrip(":"), exception)))
